//! Stack files of the real kinds: what a user meets.

use super::*;
use crate::stacks::STACKS;

const PROGRAM: &str = "PROGRAM Main\n  VAR\n    Setpoint AT %MW0 : UINT;\n    Shown AT %MW1 : UINT;\n  END_VAR\n  \
                       Shown := Speed;\n  Command := Setpoint;\nEND_PROGRAM\n";

/// A folder that goes with its owner.
pub struct Folder(pub PathBuf);

impl Folder {
    pub fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("dinrail-real-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        std::fs::create_dir_all(&dir).unwrap();
        std::fs::write(dir.join("main.st"), PROGRAM).unwrap();
        Self(dir)
    }

    pub fn load(&self, text: &str) -> Result<Loaded, LoadError> {
        let name = Path::new("stack.toml");
        Loader { free_shm: None, ..Loader::new(name, &self.0.join("stack.toml"), &self.0) }.load(text)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

pub const STACK: &str = r#"[stack]
name = "real"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
serve = { socketcand = "127.0.0.1:29536" }

[[service]]
name = "io"
kind = "can-io"
bus = "can0"

[[service.in]]
id = 0x123
start = 0
len = 16
to = "%IW0"
symbol = "Speed"

[[service.out]]
id = 0x210
dlc = 2
mode = "on_change"
signals = [{ start = 0, len = 16, from = "%QW0", symbol = "Command" }]

[[service]]
name = "plc"
kind = "plc"
program = ["main.st"]

[[service]]
name = "modbus"
kind = "modbus-server"
tcp = { address = "127.0.0.1", port = 1502 }

[[service]]
name = "rec"
kind = "recorder"
max_size = "1MiB"
keep = "2MiB"
min_free = "1MiB"
"#;

#[test]
fn a_stack_of_all_kinds_is_right() {
    let folder = Folder::new("right");
    match folder.load(STACK) {
        Ok(loaded) => {
            let shown: Vec<String> = loaded.findings.iter().map(Located::to_string).collect();
            assert!(shown.is_empty(), "{}", shown.join("\n"));
            let wakes = &loaded.stack.topic("io/inputs").unwrap().wakes;
            assert!(wakes.iter().any(|w| w == "plc"));
            assert!(loaded.stack.topic("plc/writes").unwrap().writers.contains(&"modbus".to_owned()));
        }
        Err(error) => panic!("{error}"),
    }
}

#[test]
fn mistakes_in_a_stack_of_all_kinds_name_their_line() {
    let folder = Folder::new("wrong");
    let with = |from: &str, to: &str| {
        assert!(STACK.contains(from), "{from}");
        STACK.replacen(from, to, 1)
    };
    let two_servers = format!(
        "{STACK}\n[[service]]\nname = \"modbus2\"\nkind = \"modbus-server\"\ntcp = {{ address = \"127.0.0.1\", port = 1502 }}\n"
    );
    let second_owner = format!(
        "{STACK}\n[[service]]\nname = \"io2\"\nkind = \"can-io\"\n\n[[service.in]]\nid = 5\nstart = 0\nlen = 8\nto = \"%IB1\"\n"
    );
    let cases = [
        ("unknown key", with("backend = ", "bakend = ")),
        ("unknown key in a list of tables", with("len = 16\nto", "len = 16\ntimout = \"1s\"\nto")),
        ("missing key in a list of tables", with("start = 0\n", "")),
        ("wrong type", with("port = 1502", "port = \"1502\"")),
        ("number too large", with("port = 1502", "port = 70000")),
        ("neither form of an address", with("\"127.0.0.1:29536\"", "29536")),
        ("unknown bus", with("bus = \"can0\"", "bus = \"can1\"")),
        ("bad %-address", with("%IW0", "%IX0.9")),
        ("range owned twice", second_owner),
        ("port used twice", two_servers),
        ("beyond %I", with("%IW0", "%IW2048")),
        ("missing program", with("main.st", "mian.st")),
    ];
    let mut text = String::new();
    for (title, case) in cases {
        let error = folder.load(&case).expect_err(title);
        text += &format!("### {title}\n{error}\n\n");
    }
    insta::with_settings!({ prepend_module_to_snapshot => false, omit_expression => true }, {
        insta::assert_snapshot!("real_kinds", text);
    });
}

#[test]
fn a_program_that_does_not_compile_is_shown_with_its_place() {
    let folder = Folder::new("program");
    std::fs::write(folder.0.join("main.st"), PROGRAM.replace("Shown := Speed", "Shown := Sped")).unwrap();
    let error = folder.load(STACK).unwrap_err().to_string();
    assert!(
        error.contains("stack.toml:31:") && error.contains("Sped") && error.contains("main.st"),
        "{error}"
    );
}

#[test]
fn a_register_that_the_program_assigns_too_is_a_warning() {
    let folder = Folder::new("registers");
    let map = "\n[[service.map]]\ntable = \"holding_registers\"\nat = 0\ncount = 2\narea = \"%MW0\"\n";
    let text = STACK.replacen("port = 1502 }\n", &format!("port = 1502 }}\n{map}"), 1);
    let loaded = folder.load(&text).unwrap();
    let shown: Vec<&str> = loaded.findings.iter().map(|f| f.message.as_str()).collect();
    assert_eq!(shown.len(), 1, "{shown:?}");
    assert!(shown[0].contains("holding_registers 1 (40002)") && shown[0].contains("main.st:6"), "{shown:?}");
    assert_eq!(loaded.findings[0].excerpt, "[[service.map]]");
    // The setpoint alone is the client's.
    assert!(folder.load(&text.replace("count = 2", "count = 1")).unwrap().findings.is_empty());
    // The map of a unit is no different.
    let unit = format!("\n[[service.unit]]\nid = 5\n{}", map.replace("service.map", "service.unit.map"));
    let text = STACK.replacen("port = 1502 }\n", &format!("port = 1502 }}\n{unit}"), 1);
    let loaded = folder.load(&text).unwrap();
    let shown: Vec<&str> = loaded.findings.iter().map(|f| f.message.as_str()).collect();
    assert_eq!(shown.len(), 1, "{shown:?}");
    assert!(shown[0].contains("holding_registers 1 (40002) of unit 5, but"), "{shown:?}");
    assert_eq!(loaded.findings[0].excerpt, "[[service.unit.map]]");
}

#[test]
fn every_ready_stack_is_right() {
    for ready in STACKS {
        let dir = std::env::temp_dir().join(format!("dinrail-ready-{}-{}", ready.name, std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        ready.write_to(&dir).unwrap();
        let result = load(&dir);
        std::fs::remove_dir_all(&dir).unwrap();
        if let Err(error) = result {
            panic!("{}: {error}", ready.name);
        }
    }
}
