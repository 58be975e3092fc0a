//! What files of the field do wrong, one kind at a time: every kind is read, and costs a warning that says what was
//! made of it. The first table holds the kinds for which python-canopen 2.4.1 refuses the whole file.

use super::*;
use std::fmt::Write;

const BASE: &str = "[DeviceInfo]
VendorNumber=1
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=1
PDOMapping=0
[MandatoryObjects]
SupportedObjects=1
1=0x1000
";

/// `BASE` with one text replaced by another, and something added behind it.
fn rough(from: &str, to: &str, more: &str) -> Vec<u8> {
    assert!(BASE.contains(from), "{from}");
    format!("{}{more}", BASE.replacen(from, to, 1)).into_bytes()
}

/// An object of the manufacturer with these lines.
fn object(lines: &str) -> String {
    format!(
        "[2000]\nParameterName=Own\nObjectType=0x7\nAccessType=rw\n{lines}\n\
            [ManufacturerObjects]\nSupportedObjects=1\n1=0x2000\n"
    )
}

fn told(eds: &Eds) -> String {
    eds.warnings.iter().fold(String::new(), |mut all, diag| {
        let _ = writeln!(all, "  {diag}");
        all
    })
}

/// Kinds that end python-canopen's reading with an exception.
fn refused_elsewhere() -> Vec<(&'static str, Vec<u8>)> {
    let plain = |to: &str, more: &str| rough("VendorNumber=1", to, more);
    let twice = "PDOMapping=0\nPDOMapping=1";
    let orphan = "[2000sub1]\nParameterName=x\nDataType=5\nAccessType=rw\n[ManufacturerObjects]\n\
        1=0x2000\nSupportedObjects=1\n";
    let early = "[1018sub1]\nParameterName=Vendor\nDataType=7\nAccessType=ro\n[1018]\n\
        ParameterName=Identity\nObjectType=9\nSubNumber=2\n[1018sub0]\nParameterName=n\n\
        DataType=5\nAccessType=ro\nDefaultValue=1\n[OptionalObjects]\nSupportedObjects=1\n\
        1=0x1018\n";
    let dummies = (1..=7).fold("[DummyUsage]\n".to_owned(), |all, n| format!("{all}Dummy{n:04}=0x1\n"));
    let names = "[2000]\nParameterName=Own\nObjectType=8\nDataType=5\nAccessType=rw\nCompactSubObj=2\n\
        [2000Name]\n1=First\n[ManufacturerObjects]\nSupportedObjects=1\n1=0x2000\n";
    let latin = plain("VendorName=Ger\u{1}t", "").into_iter().map(|byte| if byte == 1 { 0xE4 } else { byte });
    let wide = [0xFF, 0xFE].into_iter().chain(BASE.encode_utf16().flat_map(u16::to_le_bytes));
    vec![
        ("number with leading zeros", plain("VendorNumber=001", "")),
        ("empty PDOMapping", rough("PDOMapping=0", "PDOMapping=", "")),
        ("word for PDOMapping", rough("PDOMapping=0", "PDOMapping=TRUE", "")),
        ("empty ObjectType", rough("ObjectType=0x7", "ObjectType=", "")),
        ("word for DataType", rough("DataType=0x0007", "DataType=UNSIGNED32", "")),
        ("DataType with leading zeros", rough("DataType=0x0007", "DataType=0007", "")),
        ("Latin-1", latin.collect()),
        ("UTF-16", wide.collect()),
        ("UTF-8 with byte order mark", format!("\u{FEFF}{BASE}").into_bytes()),
        ("section twice", plain("", "[1000]\nParameterName=Again\n")),
        ("key twice", rough("PDOMapping=0", twice, "")),
        ("line without =", plain("just words", "")),
        ("line before the first section", format!("Made by a tool\n{BASE}").into_bytes()),
        ("end mark of DOS", plain("", "\u{1A}")),
        ("sub-object without object", plain("", orphan)),
        ("sub-object before its object", plain("", early)),
        ("no ParameterName", rough("ParameterName=Device type\n", "", "")),
        ("no DataType", rough("DataType=0x0007\n", "", "")),
        ("no AccessType", rough("AccessType=ro\n", "", "")),
        ("hexadecimal dummies", plain("", &dummies)),
        ("some dummies only", plain("", "[DummyUsage]\nDummy0001=0\n")),
        ("comments without Lines", plain("", "[Comments]\nLine1=x\n")),
        ("fewer comments than Lines", plain("", "[Comments]\nLines=2\nLine1=x\n")),
        ("hexadecimal Baudrate", plain("", "[DeviceComissioning]\nNodeID=5\nBaudrate=0x1F4\n")),
        ("names without their number", plain("", names)),
    ]
}

/// Kinds that others read, some of them as something else than was meant.
fn misread_elsewhere() -> Vec<(&'static str, Vec<u8>)> {
    let plain = |more: &str| format!("{BASE}{more}").into_bytes();
    let value =
        |data_type: u16, text: &str| plain(&object(&format!("DataType={data_type}\nDefaultValue={text}")));
    let of_type = "[A0]\nParameterName=UNSIGNED8[1-5]\nObjectType=0x5\nSubNumber=4\n[A0sub0]\n\
        ParameterName=n\nDataType=5\nAccessType=ro\nDefaultValue=3\n[A0sub1]\n\
        ParameterName=Type\nDataType=5\nAccessType=ro\nDefaultValue=0x5\n[A0sub2]\n\
        ParameterName=Minimum\nDataType=5\nAccessType=ro\nDefaultValue=1\n[A0sub3]\n\
        ParameterName=Maximum\nDataType=5\nAccessType=ro\nDefaultValue=5\n";
    let hundred = "[2000]\nParameterName=Own\nObjectType=8\nSubNumber=2\n[2000sub0]\nParameterName=n\n\
        DataType=5\nAccessType=ro\nDefaultValue=1\n[2000sub100]\nParameterName=Hundred\n\
        DataType=5\nAccessType=rw\n[ManufacturerObjects]\nSupportedObjects=1\n1=0x2000\n";
    vec![
        ("line ends of old Macs", BASE.replace('\n', "\r").into_bytes()),
        ("line ends doubled", BASE.replace('\n', "\r\r\n").into_bytes()),
        ("blank in a key", rough("SupportedObjects", "Supported Objects", "")),
        ("comment behind a word", rough("AccessType=ro", "AccessType=ro ; read only", "")),
        ("real for an integer", value(7, "0.0")),
        ("real with a fraction for an integer", value(7, "0.5")),
        ("h behind a number", value(7, "180h")),
        ("no 0x in front", value(7, "000F0191")),
        ("word for a number", value(7, "FADE")),
        ("NODEID without $", value(7, "NODEID+0x80")),
        ("formula with blanks", value(7, "$NodeID + 0x80000200")),
        (
            "type of the file itself",
            plain(&format!("{of_type}{}", object("DataType=0x00A0\nDefaultValue=3"))),
        ),
        ("decimal sub-index", plain(hundred)),
        (
            "modules",
            plain(
                "[SupportedModules]\nNrOfEntries=2\n[M1ModuleInfo]\nProductName=x\n[M1SubExt6000]\n\
                    ParameterName=y\n",
            ),
        ),
    ]
}

#[test]
fn every_kind_is_read_with_its_warning() {
    let mut all = String::new();
    for (name, file) in refused_elsewhere().into_iter().chain(misread_elsewhere()) {
        let eds = Eds::parse(&file).unwrap_or_else(|fault| panic!("{name}: {fault}"));
        let od =
            eds.builder(&BuildOptions::default()).build(5).unwrap_or_else(|fault| panic!("{name}: {fault}"));
        let _ = writeln!(all, "{name}\n{}", told(&eds).trim_end());
        // The device type is there in any case; without its DataType as bytes.
        assert!(od.bytes(0x1000, 0).is_some(), "{name}");
        if name != "no DataType" {
            assert_eq!(od.u32(0x1000, 0), Some(1), "{name}");
        }
        if let Some(entry) = eds.entry(0x2000, 0) {
            let value = od.bytes(0x2000, 0).unwrap_or_default();
            let _ = writeln!(all, "  -> {:?} {value:02X?} {:?} {:?}", entry.data_type, entry.low, entry.high);
        }
    }
    insta::assert_snapshot!(all);
}

#[test]
fn what_a_tool_does_everywhere_is_told_a_few_times() {
    let mut file = BASE.to_owned();
    for n in 0..300 {
        let _ = write!(
            file,
            "[{:04X}]\nParameterName=P\nDataType=3\nAccessType=rw\nDefaultValue=1\nLowLimit=0\nHighLimit=0\n",
            0x2000 + n
        );
    }
    file.push_str("[ManufacturerObjects]\nSupportedObjects=300\n");
    (0..300).for_each(|n| {
        let _ = writeln!(file, "{}=0x{:04X}", n + 1, 0x2000 + n);
    });
    let eds = Eds::parse(file.as_bytes()).unwrap();
    assert_eq!(eds.objects.len(), 301);
    assert_eq!(eds.warnings.len(), ALIKE + 1);
    assert_eq!(
        eds.warnings[ALIKE].to_string(),
        "line 54: [2005] HighLimit: both limits are 0: taken as no limits (so 294 times more, up to line 2112)"
    );
    assert_eq!(eds.check().len(), ALIKE + 4, "1001h, 1018h and the bit rate miss, and no more");
}

#[test]
fn a_mapping_of_zeros_is_one_finding() {
    let mut file = BASE.to_owned();
    file.push_str(
        "[1A00]\nParameterName=TPDO 1\nObjectType=9\nSubNumber=9\n[1A00sub0]\n\
        ParameterName=n\nDataType=5\nAccessType=rw\nDefaultValue=8\n",
    );
    for sub in 1..=8 {
        let _ = write!(file, "[1A00sub{sub}]\nParameterName=m\nDataType=7\nAccessType=rw\nDefaultValue=0\n");
    }
    let eds = Eds::parse(file.as_bytes()).unwrap();
    let found: Vec<String> =
        eds.check().iter().map(ToString::to_string).filter(|text| text.contains("1A00sub")).collect();
    assert_eq!(
        found,
        [
            "line 21: [1A00sub0] DefaultValue: says 8 objects are mapped, of which 8 are 0: nobody can use the PDO"
        ]
    );
}
