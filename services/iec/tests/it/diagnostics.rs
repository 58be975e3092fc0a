//! Every code of the table occurs, and only where it should; rendered messages are pinned.

use std::collections::BTreeSet;

use dinrail_iec::codes::CODES;
use dinrail_iec::{ExternalSymbol, Options, compile};

use crate::host::source;

/// Codes a source gets, warnings too.
fn codes_of(text: &str, options: &Options) -> BTreeSet<&'static str> {
    match compile(&source(text), options) {
        Ok(c) => c.warnings.iter().map(|d| d.code).collect(),
        Err(d) => d.items().iter().map(|d| d.code).collect(),
    }
}

#[test]
fn bad_examples_get_their_code_and_good_ones_none() {
    let mut wrong = Vec::new();
    for c in CODES {
        let bad = codes_of(c.bad, &Options::default());
        if !c.bad.is_empty() && bad != BTreeSet::from([c.id]) {
            wrong.push(format!("{}: bad example gets {bad:?}: {}", c.id, c.bad));
        }
        let good = codes_of(c.good, &Options::default());
        if !good.is_empty() {
            wrong.push(format!("{}: good example gets {good:?}: {}", c.id, c.good));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(CODES.windows(2).all(|w| w[0].id < w[1].id), "the table is in order");
}

/// Every code the sources of the compiler mention is in the table, and the other way round.
#[test]
fn table_and_compiler_agree() {
    fn collect(dir: &std::path::Path, found: &mut BTreeSet<String>) {
        for entry in std::fs::read_dir(dir).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                collect(&path, found);
            } else if path.file_name().is_some_and(|n| n != "codes.rs") {
                let text = std::fs::read_to_string(&path).unwrap();
                for (at, _) in text.match_indices('"') {
                    let word: String = text[at + 1..].chars().take(6).collect();
                    let mut c = word.chars();
                    if matches!(c.next(), Some('E' | 'W'))
                        && word.ends_with('"')
                        && word.len() == 6
                        && word[1..5].bytes().all(|b| b.is_ascii_digit())
                    {
                        found.insert(word[..5].to_owned());
                    }
                }
            }
        }
    }
    let mut found = BTreeSet::new();
    collect(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut found);
    let table: BTreeSet<String> = CODES.iter().map(|c| c.id.to_owned()).collect();
    assert_eq!(found, table);
}

#[test]
fn the_docs_page_lists_every_code() {
    let page =
        std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/src/reference/diagnostics.md");
    let text = std::fs::read_to_string(&page).unwrap();
    for c in CODES {
        assert!(
            text.contains(&format!("| {} | {} |", c.id, c.title)),
            "{} is missing in {}",
            c.id,
            page.display()
        );
    }
    let documented = text.lines().filter(|l| l.starts_with("| E0") || l.starts_with("| W0")).count();
    assert_eq!(documented, CODES.len());
}

#[test]
fn rendered_messages() {
    let mut all = String::new();
    for c in CODES.iter().filter(|c| !c.bad.is_empty() && c.id != "E0802") {
        let options = Options::default();
        let text = match compile(&source(c.bad), &options) {
            Ok(ok) => ok.render_warnings(&source(c.bad), false),
            Err(d) => d.render(false),
        };
        all.push_str(&text);
    }
    insta::assert_snapshot!(all);
}

#[test]
fn several_errors_of_a_file_in_one_go() {
    let text = "PROGRAM p
VAR
  a : INT
  b : BOOL;
  c : NOSUCH;
END_VAR
a := ;
IF b THEN
  a := TRUE;
ELSE
  b := 1.5;
END_IF
WHILE a DO a := a - 1; END_WHILE;
d := 3;
a := (1 + 2;
a := 5;
END_PROGRAM
PROGRAM q
VAR x : ARRAY [1..3] OF DINT; END_VAR
x[4] := 1;
x[1] := x;
END_PROGRAM
";
    let d = compile(&source(text), &Options::default()).unwrap_err();
    insta::assert_snapshot!(d.render(false));
}

#[test]
fn errors_of_the_stack_file() {
    let external = |name: &str, address: &str, type_name: &str| Options {
        externals: vec![ExternalSymbol {
            name: name.to_owned(),
            address: address.to_owned(),
            type_name: type_name.to_owned(),
            origin: "stack.toml:12".to_owned(),
        }],
        ..Options::default()
    };
    let mut all = String::new();
    let program = "VAR_GLOBAL Level : INT; END_VAR PROGRAM p END_PROGRAM";
    for options in [
        external("Buttons", "%IX0.9", "BOOL"),
        external("Buttons", "%IB0", "BOOL"),
        external("Buttons", "%IB0", "BYTES"),
        external("Buttons", "%IB4096", "BYTE"),
        external("2nd", "%IB0", "BYTE"),
        external("VAR", "%IB0", "BYTE"),
        external("level", "%IW0", "INT"),
        external("p", "%IW0", "INT"),
        Options { input_bytes: 70_000, ..Options::default() },
    ] {
        let d = compile(&source(program), &options).unwrap_err();
        all.push_str(&d.render(false));
    }
    let with_task = "PROGRAM p END_PROGRAM CONFIGURATION c RESOURCE r ON x TASK t(INTERVAL := T#10ms); PROGRAM i WITH t : p; END_RESOURCE END_CONFIGURATION";
    let options = Options { implicit_cycle_ns: Some(1_000_000), ..Options::default() };
    all.push_str(&compile(&source(with_task), &options).unwrap_err().render(false));
    insta::assert_snapshot!(all);
}

#[test]
fn colour_only_when_asked_for() {
    let d = compile(&source("PROGRAM p x := 1; END_PROGRAM"), &Options::default()).unwrap_err();
    assert!(!d.render(false).contains('\u{1b}'));
    assert!(d.render(true).contains('\u{1b}'));
}

/// A file of one line must not come out once for each of its errors.
#[test]
fn very_long_lines_are_not_shown() {
    let text = format!("PROGRAM p\nVAR x : INT; END_VAR {} y := x + ä; END_PROGRAM", "x := z; ".repeat(1000));
    let rendered = compile(&source(&text), &Options::default()).unwrap_err().render(false);
    assert!(
        rendered.contains("error[E0302]: there is no variable `z`\n  at test.st:2:27\n  = help: declare it")
    );
    assert!(rendered.len() < 100 * 200, "{}", rendered.len());
}

#[test]
fn habits_of_other_languages_get_the_spelling_of_this_one() {
    let cases = [
        ("IF x != 1 THEN x := 2; END_IF", "written `<>`"),
        ("IF !b THEN x := 2; END_IF", "written NOT"),
        ("b := b | b;", "written OR"),
        ("IF x == 1 THEN x := 2; END_IF", "written `=`"),
        ("IF b && b THEN x := 2; END_IF", "written AND"),
        ("x += 1;", "x := x + 1"),
        ("x = 5;", "written `:=`"),
        ("IF b THEN x := 1; ELSEIF NOT b THEN x := 2; END_IF", "written ELSIF"),
    ];
    for (line, help) in cases {
        let text = format!("PROGRAM p VAR x : INT; b : BOOL; END_VAR\n{line}\nEND_PROGRAM");
        let said = compile(&source(&text), &Options::default()).unwrap_err().render(false);
        assert!(said.contains(help), "{line}\n{said}");
    }
}
