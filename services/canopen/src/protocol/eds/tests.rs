use super::concise::{Item, decode, encode};
use super::*;
use crate::protocol::od::OdBuilder;
use proptest::prelude::*;
use std::fmt::Write;
use std::path::PathBuf;

/// The folder of public EDS files, if it is there.
fn cases() -> Option<PathBuf> {
    let own = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/cases"));
    let folder = std::env::var_os("DINRAIL_CASES").map_or(own, PathBuf::from).join("eds");
    if folder.is_dir() {
        return Some(folder);
    }
    assert!(std::env::var_os("DINRAIL_NO_SKIP").is_none(), "the public cases are missing: set DINRAIL_CASES");
    eprintln!("skipped: the public cases are missing (DINRAIL_CASES)");
    None
}

fn read(name: &str) -> Option<Eds> {
    let bytes = std::fs::read(cases()?.join(name)).unwrap();
    Some(Eds::parse(&bytes).unwrap())
}

fn text(diags: &[Diag]) -> String {
    diags.iter().fold(String::new(), |mut all, diag| {
        writeln!(all, "{diag}").unwrap();
        all
    })
}

const PUBLIC: [&str; 5] = [
    "canopendemo/demo_demoDevice.eds",
    "node-canopen/example.eds",
    "python-canopen/examples_eds_e35.eds",
    "python-canopen/test_datatypes.eds",
    "python-canopen/test_sample.eds",
];

#[test]
fn every_public_file_loads() {
    let mut table = String::new();
    for name in PUBLIC {
        let Some(eds) = read(name) else { return };
        let od = eds.builder(&BuildOptions::default()).build(5).unwrap();
        let (warnings, errors) = Eds::count(&eds.check());
        let counts = [eds.objects.len(), od.entries().count(), eds.warnings.len(), warnings, errors];
        writeln!(table, "{name}: objects, entries, warnings, check: {counts:?}").unwrap();
        // Three files say right how many objects they have.
        let announced: u64 = ["MandatoryObjects", "OptionalObjects", "ManufacturerObjects"]
            .iter()
            .filter_map(|name| value::unsigned(eds.section(name)?.text("SupportedObjects")).ok())
            .map(|(count, _)| count)
            .sum();
        if name != PUBLIC[2] && name != PUBLIC[4] {
            assert_eq!(announced, eds.objects.len() as u64, "{name}");
        }
    }
    insta::assert_snapshot!(table);
}

#[test]
fn findings_in_public_files() {
    let mut all = String::new();
    for name in PUBLIC {
        let Some(eds) = read(name) else { return };
        let diags = eds.check();
        writeln!(all, "{name}\n{}", text(&diags[..diags.len().min(40)])).unwrap();
    }
    insta::assert_snapshot!(all);
}

#[test]
fn values_of_the_demo_device() {
    let Some(eds) = read(PUBLIC[0]) else { return };
    let od = eds.builder(&BuildOptions::default()).build(4).unwrap();
    assert_eq!(od.u32(0x1000, 0), Some(0x000F_0191));
    assert_eq!(od.u32(0x1014, 0), Some(0x84));
    assert_eq!(od.u32(0x1200, 1), Some(0x604));
    assert_eq!(od.u32(0x1800, 1), Some(0x4000_0184));
    assert_eq!(eds.name(0x1018, 1).as_deref(), Some("Identity, Vendor-ID"));
    assert_eq!(eds.name(0x1000, 0).as_deref(), Some("Device type"));
    assert_eq!(eds.name(0x1000, 1), None);
    assert_eq!(eds.device.baud_rates, [10, 20, 50, 125, 250, 500, 800, 1000]);
    assert_eq!((eds.device.rx_pdos, eds.device.lss_supported), (4, true));
    assert!(od.text(0x2120, 0).is_none() || od.object(0x2120).is_some());
}

#[test]
fn values_of_every_type() {
    let Some(eds) = read(PUBLIC[3]) else { return };
    let od = eds.builder(&BuildOptions::default()).build(4).unwrap();
    let int = |index| od.i64(index, 0).unwrap();
    assert_eq!(
        [0x2001, 0x2002, 0x2003, 0x2004, 0x2005, 0x2006, 0x2007, 0x2010].map(int),
        [0, 12, 34, 45, 56, 8198, 537_337_864, -1]
    );
    assert_eq!(
        [0x2012, 0x2013, 0x2014, 0x2015, 0x2016, 0x2018, 0x2019, 0x201A, 0x201B].map(int),
        [-40, -48, -56, -64, 24, 40, 48, 56, 64]
    );
    assert_eq!((od.f64(0x2008, 0), od.f64(0x2011, 0)), (Some(f64::from(1.2f32)), Some(1.6)));
    assert_eq!(od.text(0x2009, 0), Some("ABCD"));
    assert_eq!(od.bytes(0x200A, 0), Some(&[0xAB, 0xCD][..]));
    assert_eq!(od.bytes(0x200B, 0), Some(&[b'a', 0, b'b', 0, b'c', 0, 0x13, 0x27][..]));
    assert_eq!(od.bytes(0x200F, 0), Some(&b"@ABCD"[..]));
    assert_eq!(eds.dummies, 0xFC);
}

#[test]
fn values_of_the_sample() {
    let Some(eds) = read(PUBLIC[4]) else { return };
    let od = eds.builder(&BuildOptions::default()).build(0x10).unwrap();
    let node = eds.commissioning.as_ref().unwrap();
    assert_eq!((node.node_id, node.node_name.as_str(), node.baud_rate), (0x10, "Some name", 500));
    assert_eq!(eds.comments[1], "| Don't panic |");
    assert_eq!(od.u32(0x1403, 1), Some(0x510));
    assert_eq!(eds.name(0x3004, 2).as_deref(), Some("Sensor Status, Sensor Status 2"));
    assert_eq!(eds.name(0x3006, 24).as_deref(), Some("Valve 1 % Open, Valve 1 % Open24"));
    assert_eq!(od.u16(0x3004, 3), Some(3));
    assert_eq!(od.u8(0x3006, 0), Some(24));
    let limits = |index| eds.entry(index, 0).map(|entry| (entry.low, entry.high)).unwrap();
    let int = |low, high| (Some(Number::Int(low)), Some(Number::Int(high)));
    assert_eq!(limits(0x3020), int(0, 127));
    assert_eq!(limits(0x3030), int(i128::from(i32::MIN), -1));
    assert_eq!(limits(0x3040), int(-10, 10));
    assert_eq!(limits(0x3002), (Some(Number::Real(4.5)), None));
    assert_eq!(eds.parameter_values(0x10), [(0x1017, 0, vec![0, 0])]);
    let configured = BuildOptions { parameter_values: true, ..BuildOptions::default() };
    let configured = eds.builder(&configured).build(0x10).unwrap();
    assert_eq!((od.u32(0x1018, 1), configured.u32(0x1018, 1)), (Some(0), Some(1)));
}

/// Everything that makes other readers refuse a file, and some more.
const ROUGH: &str = "\u{FEFF}text before any section
[FileInfo]
FileName=rough.eds
[DeviceInfo]
VendorName=An maker
VendorNumber=0x1G
VendorName=Other
Granularity=8 ; bits
NrOfRXPDO=08
BaudRate_125=TRUE
NodeIDs
[MandatoryObjects]
SupportedObjects=3
1=0x1000
2=0x1001
3=0x1018
[OptionalObjects]
SupportedObjects=1
1=0x1234
[1000
ParameterName=Device type
DataType=0x0007
AccessType=ro
DefaultValue=0x000F0191 ; CiA 401
[1001] trailing
ObjectType=7
DataType=05
AccessType=
[1001]
ParameterName=Error register
[ 1018 ]
ParameterName=\"Identity\"
SubNumber=017
[1018SUB1]
ParameterName=Vendor
ObjectType=0x07
DataType=0x0007
AccessType=RO
DefaultValue=0x1FFFFFFFF
[1018sub 2]
ParameterName=Product
DataType=0x7
AccessType=read
[0x2000]
ParameterName=Speed
ObjectType=0x7
DataType=0x0003
AccessType=rww
LowLimit=0
HighLimit=0
DefaultValue=0xFFFF
PDOMapping=0x01
[2001]
ParameterName=Real
DataType=0x8
AccessType=rw
DefaultValue=1,5
LowLimit=2
HighLimit=1
[2002]
ParameterName=Octets
DataType=0xA
AccessType=rw
DefaultValue=See manual
[2003sub1]
ParameterName=Orphan
DataType=1
AccessType=rw
DefaultValue=true
[2004]
ParameterName=Formulas
ObjectType=0x9
SubNumber=4
[2004sub1]
ParameterName=A
DataType=7
AccessType=rw
DefaultValue= 0x100 + $nodeid + 010
[2004sub2]
ParameterName=B
DataType=7
AccessType=rw
DefaultValue=$NODEID-1
[2004sub3]
ParameterName=C
DataType=7
AccessType=rw
DefaultValue=$NODEID
[2005]
ParameterName=Odd
ObjectType=77
DataType=0x21
AccessType=wo
ObjFlags=3
[2005Name]
1=Nothing
[2006Value]
1=2
[ZZZZ]
a=b
[2007subXY]
x=y
[\u{20AC}\u{20AC}]
";

#[test]
fn rough_files_cost_warnings() {
    let eds = Eds::parse(ROUGH.as_bytes()).unwrap();
    insta::assert_snapshot!(text(&eds.warnings));
    let od = eds.builder(&BuildOptions::default()).build(7).unwrap();
    assert_eq!(od.u32(0x1000, 0), Some(0x000F_0191));
    assert_eq!(od.i64(0x2000, 0), Some(-1));
    assert_eq!(od.f64(0x2001, 0), Some(1.5));
    assert_eq!(od.text(0x2002, 0), Some("See manual"));
    assert_eq!(od.u32(0x2004, 1), Some(0x100 + 7 + 8));
    assert_eq!(od.u32(0x2004, 2), Some(0));
    assert_eq!(od.u32(0x2004, 3), Some(7));
    assert_eq!(od.bool(0x2003, 1), Some(true));
    assert_eq!(od.u8(0x1018, 0), Some(2));
    assert_eq!(eds.device.vendor_name, "An maker");
    assert_eq!(eds.device.rx_pdos, 8);
    let entry = eds.entry(0x2005, 0).unwrap();
    assert!(entry.no_download && entry.no_scan);
}

#[test]
fn other_encodings() {
    let latin: Vec<u8> = "[1000]\r\nParameterName=Ger\u{e4}t\r\nDataType=7\r\nAccessType=ro\r\n"
        .chars()
        .map(|c| c as u8)
        .collect();
    let eds = Eds::parse(&latin).unwrap();
    assert_eq!(eds.name(0x1000, 0).as_deref(), Some("Ger\u{e4}t"));
    assert_eq!(
        eds.warnings[1].to_string(),
        "line 1: [1000]: in none of the lists of objects: taken nevertheless"
    );
    assert_eq!(eds.warnings[2].to_string(), "line 2: the file is not UTF-8: read as Latin-1");
    let wide: Vec<u8> = [0xFF, 0xFE]
        .into_iter()
        .chain(
            "[1000]\nParameterName=x\u{20AC}\nDataType=7\nAccessType=ro"
                .encode_utf16()
                .flat_map(u16::to_le_bytes),
        )
        .collect();
    assert_eq!(Eds::parse(&wide).unwrap().name(0x1000, 0).as_deref(), Some("x\u{20AC}"));
}

#[test]
fn what_is_no_eds_is_refused() {
    let fault = |bytes: &[u8]| Eds::parse(bytes).unwrap_err().to_string();
    assert_eq!(
        fault(b""),
        "the file describes no object: it has no section like [1000]; is it an EDS or DCF?"
    );
    assert_eq!(fault(b"[stack]\nname = 1"), fault(b""));
    assert!(fault(b" <?xml version=\"1.0\"?>").starts_with("line 1: the file is XML"));
    let long = format!("[1000]\n{}", "x".repeat(limit::LINE + 1));
    assert_eq!(fault(long.as_bytes()), "line 2: longer than 1048576 bytes: is the file an EDS?");
    assert_eq!(Eds::parse(&vec![b' '; limit::FILE + 1]), Err(EdsError::TooLarge(limit::FILE + 1)));
    let many: String = (0..1000u32).fold(String::new(), |mut all, n| {
        write!(
            all,
            "[{:04X}]\nObjectType=8\nCompactSubObj=254\nDataType=5\nAccessType=ro\nParameterName=a\n",
            0x2000 + n
        )
        .unwrap();
        all
    });
    assert_eq!(Eds::parse(many.as_bytes()), Err(EdsError::TooManyEntries));
    let warnings = (0..3000).fold("[1000]\n".to_owned(), |all, n| format!("{all}no key {n}\n"));
    let eds = Eds::parse(warnings.as_bytes()).unwrap();
    assert_eq!(eds.warnings.len(), limit::WARNINGS + 1);
}

#[test]
fn compact_pdos_are_made() {
    let file = "[DeviceInfo]\nCompactPDO=0x13\nGranularity=8\nNrOfRXPDO=5\nNrOfTXPDO=1\n\
        [1000]\nParameterName=a\nDataType=7\nAccessType=ro\n\
        [1800]\nParameterName=Own\nObjectType=9\nSubNumber=2\n\
        [1800sub0]\nParameterName=n\nDataType=5\nAccessType=ro\nDefaultValue=1\n\
        [1800sub1]\nParameterName=COB-ID\nDataType=7\nAccessType=rw\nDefaultValue=$NODEID+0x180\n";
    let eds = Eds::parse(file.as_bytes()).unwrap();
    let od = eds.builder(&BuildOptions::default()).build(3).unwrap();
    assert_eq!(od.u32(0x1401, 1), Some(0x303));
    assert_eq!(od.u32(0x1404, 1), Some(0x8000_0000));
    assert_eq!(od.u8(0x1400, 0), Some(5));
    assert!(od.find(0x1400, 5).is_ok() && od.find(0x1400, 3).is_err());
    assert_eq!(od.entries_of(0x1604).count(), 9);
    assert_eq!(eds.objects[&0x1800].name, "Own");
    assert!(od.object(0x1A00).is_some() && od.object(0x1405).is_none());
    // A value for an object that the file leaves out is described whole.
    let options = DcfOptions {
        commissioning: Commissioning { node_id: 3, ..Default::default() },
        ..Default::default()
    };
    let dcf = eds.dcf(&options, &[(0x1600, 1, vec![8, 0, 0, 0x62])]).unwrap();
    let again = Eds::parse(dcf.as_bytes()).unwrap();
    assert_eq!(again.parameter_values(3), [(0x1600, 1, vec![8, 0, 0, 0x62])]);
    assert_eq!(again.objects[&0x1600].subs.len(), 9);
}

/// Bytes of a value that differs from the default, for every type.
fn other(entry: &EdsEntry, seed: u8) -> Vec<u8> {
    match entry.data_type {
        DataType::Boolean => vec![seed & 1],
        DataType::VisibleString => format!("text {seed}").into_bytes(),
        DataType::UnicodeString => "\u{20AC}".encode_utf16().flat_map(u16::to_le_bytes).collect(),
        DataType::Real32 => f32::from(seed).sqrt().to_le_bytes().to_vec(),
        DataType::Real64 => f64::from(seed).sqrt().to_le_bytes().to_vec(),
        other => vec![seed; other.size().unwrap_or(usize::from(seed % 5))],
    }
}

#[test]
fn a_dcf_gives_back_what_went_in() {
    let own = Eds::parse(ROUGH.as_bytes()).unwrap();
    let public = PUBLIC.into_iter().filter_map(read);
    for eds in [own].into_iter().chain(public) {
        let values: Vec<_> = eds
            .entries()
            .filter(|(_, _, entry)| entry.access.writable() && !entry.no_download)
            .enumerate()
            .map(|(n, (index, sub, entry))| (index, sub, other(entry, (n as u8).wrapping_add(1))))
            .filter(|(_, _, bytes)| !bytes.is_empty())
            .collect();
        let commissioning = Commissioning {
            node_id: 42,
            node_name: "pump".into(),
            baud_rate: 250,
            net_number: 1,
            network_name: "line".into(),
            manager: false,
            lss_serial_number: 7,
        };
        let options = DcfOptions {
            commissioning: commissioning.clone(),
            file_name: "pump.dcf".into(),
            eds_name: "pump.eds".into(),
        };
        let dcf = eds.dcf(&options, &values).unwrap();
        let again = Eds::parse(dcf.as_bytes()).unwrap();
        assert_eq!(again.commissioning, Some(commissioning));
        assert_eq!(again.section("FileInfo").unwrap().text("LastEDS"), "pump.eds");
        assert_eq!(
            (&again.device, again.dummies, &again.comments),
            (&eds.device, eds.dummies, &eds.comments)
        );
        let writable = |values: &[(u16, u8, Vec<u8>)]| values.to_vec();
        assert_eq!(again.parameter_values(42), writable(&values));
        for ((index, sub, old), (_, _, new)) in eds.entries().zip(again.entries()) {
            let strip = |entry: &EdsEntry| EdsEntry { line: 0, parameter: None, ..entry.clone() };
            assert_eq!(strip(old), strip(new), "{index:04X}:{sub:02X}");
        }
        // And once more: the same text.
        assert_eq!(again.dcf(&options, &values).unwrap(), dcf);
        // The concise form carries the same values.
        let items: Vec<_> =
            values.iter().map(|(index, sub, data)| Item { index: *index, sub: *sub, data }).collect();
        let concise = encode(items.iter().copied());
        assert_eq!(decode(&concise).unwrap(), items);
    }
}

#[test]
fn faults_of_a_dcf() {
    let eds = Eds::parse(ROUGH.as_bytes()).unwrap();
    let write = |node_id, values: &[(u16, u8, Vec<u8>)]| {
        let commissioning = Commissioning { node_id, ..Commissioning::default() };
        eds.dcf(&DcfOptions { commissioning, ..DcfOptions::default() }, values).unwrap_err().to_string()
    };
    let mut all = String::new();
    for fault in
        [write(0, &[]), write(128, &[]), write(1, &[(0x5000, 1, vec![])]), write(1, &[(0x2000, 0, vec![1])])]
    {
        writeln!(all, "{fault}").unwrap();
    }
    insta::assert_snapshot!(all, @r"
    0 is no node-id: give 1 to 127
    128 is no node-id: give 1 to 127
    the EDS has no object 5000h:01
    object 2000h:00: 1 bytes are no INTEGER16, which has 2
    ");
}

#[test]
fn numbers_of_every_kind() {
    for (text, want) in [
        ("10", Some(10)),
        ("0x1F", Some(31)),
        ("0X1f", Some(31)),
        ("010", Some(8)),
        ("0", Some(0)),
        ("00", Some(0)),
        ("09", Some(9)),
        (" 12 ", Some(12)),
        ("0x10UL", None),
        ("0x10u", Some(16)),
        ("12 ; note", Some(12)),
        ("-1", None),
        ("", None),
        ("0x", None),
        ("x", None),
        ("1e3", None),
        ("0x123456789ABCDEF01", None),
        ("--1", None),
    ] {
        assert_eq!(value::unsigned(text).ok().map(|(value, _)| value), want, "{text}");
    }
}

#[test]
fn bits_of_a_real_stay_as_they_are() {
    let signalling = [0, 0, 0x81, 0x7F];
    let text = value::format(DataType::Real32, &signalling).unwrap();
    assert_eq!(text, "0x7F810000");
    assert_eq!(value::parse(&text, DataType::Real32).unwrap().0.unwrap().bytes, signalling);
    assert!(value::parse("0x17F810000", DataType::Real32).is_err());
    assert_eq!(value::parse("1,5", DataType::Real32).unwrap().0.unwrap().bytes, 1.5_f32.to_le_bytes());
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes: Vec<u8>) {
        let _ = Eds::parse(&bytes);
    }

    /// A good file with lines lost, repeated, swapped and bent.
    #[test]
    fn bent_files(edits in prop::collection::vec((0usize..110, 0u8..6, any::<char>(), 0usize..40), 1..12)) {
        let mut lines: Vec<String> = ROUGH.lines().map(str::to_owned).collect();
        for (at, kind, c, column) in edits {
            let last = lines.len() - 1;
            let at = at.min(last);
            match kind {
                0 => drop(lines.remove(at)),
                1 => lines.insert(at, lines[at].clone()),
                2 => lines.swap(at, column.min(last)),
                3 => lines[at] = lines[at].chars().take(column).collect(),
                4 => lines[at] = lines[at].chars().enumerate().map(|(n, old)| if n == column { c } else { old }).collect(),
                _ => lines[at].push(c),
            }
        }
        if let Ok(eds) = Eds::parse(lines.join("\n").as_bytes()) {
            eds.check();
            prop_assert!(eds.names().count() > 0);
            let od = eds.builder(&BuildOptions::default()).build(5).unwrap();
            prop_assert!(od.entries().count() > 0);
            let commissioning = Commissioning { node_id: 5, ..Commissioning::default() };
            let options = DcfOptions { commissioning, ..DcfOptions::default() };
            let dcf = eds.dcf(&options, &[]).unwrap();
            let again = Eds::parse(dcf.as_bytes()).unwrap();
            prop_assert_eq!(again.parameter_values(5), eds.parameter_values(5));
            prop_assert_eq!(again.objects.len(), eds.objects.len());
        }
    }

    /// Also a signalling NaN, whose bits a conversion to another width would change.
    #[test]
    fn a_formatted_value_reads_back(index in 1u16..0x1C, bytes: [u8; 8]) {
        let data_type = DataType::from_index(index);
        let mut bytes = bytes[..data_type.size().unwrap_or(6)].to_vec();
        if data_type == DataType::Boolean {
            bytes[0] &= 1;
        }
        if let Some(text) = value::format(data_type, &bytes) {
            let (value, _) = value::parse(&text, data_type).unwrap();
            prop_assert_eq!(value.map(|value| value.bytes), Some(bytes), "{}", text);
        }
    }
}

/// An [`OdBuilder`] is also what hand-made dictionaries come from: both kinds agree.
#[test]
fn a_file_and_a_hand_agree() {
    let file =
        "[1017]\nParameterName=Producer heartbeat time\nDataType=6\nAccessType=rw\nDefaultValue=1000\n";
    let read = Eds::parse(file.as_bytes()).unwrap().builder(&BuildOptions::default()).build(1).unwrap();
    let mut hand = OdBuilder::new();
    hand.var(0x1017, crate::protocol::od::EntryDef::new(DataType::Unsigned16, Access::Rw).value(1000));
    let hand = hand.build(1).unwrap();
    assert_eq!(format!("{read:?}"), format!("{hand:?}"));
}
