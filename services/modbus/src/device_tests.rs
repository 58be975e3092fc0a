use super::*;
use crate::identity::IdentityConfig;
use crate::rights::RightsEntry;
use crate::testing::{MemoryImage, hex, to_hex};

const PEER: Peer = Peer::Line(0);

/// What became of a request: `-` not ours, `` silent, else the answer.
fn ask(device: &mut Device, image: &mut MemoryImage, unit: u8, pdu: &str) -> String {
    let mut out = [0; MAX_PDU];
    match device.serve(unit, &hex(pdu), &PEER, image, &mut out) {
        Served::NotOurs => "-".to_owned(),
        Served::Silent(_) => String::new(),
        Served::Answer(outcome) => to_hex(&out[..outcome.len]),
    }
}

fn line(units: &[(u8, usize)]) -> Device {
    Device::line(units, false, Shared::open())
}

#[test]
fn units_of_a_line() {
    let mut image = MemoryImage::new(10);
    let mut device = line(&[(5, 0), (6, 2)]);
    assert_eq!(ask(&mut device, &mut image, 5, "03 0000 0001"), "03020000");
    assert_eq!(ask(&mut device, &mut image, 6, "03 0000 0001"), "03020000");
    assert_eq!(image.selected, [0, 2]);
    for unit in [1, 7, 247, 255] {
        assert_eq!(ask(&mut device, &mut image, unit, "03 0000 0001"), "-", "{unit}");
    }
    let mut device = Device::line(&[(5, 0), (6, 2)], true, Shared::open());
    assert_eq!(ask(&mut device, &mut image, 255, "03 0000 0001"), "03020000");
    assert!(device.serves(255) && device.serves(0) && !device.serves(7));
}

#[test]
fn units_of_tcp() {
    let mut image = MemoryImage::new(10);
    let mut device = Device::tcp(None, &[(6, 1)], Shared::open());
    for unit in [0, 1, 6, 255] {
        assert_eq!(ask(&mut device, &mut image, unit, "03 0000 0001"), "03020000", "{unit}");
    }
    assert_eq!(image.selected, [0, 0, 1, 0]);
    let mut device = Device::tcp(Some(&[4]), &[(6, 1)], Shared::open());
    for (unit, answer) in [(0, "03020000"), (4, "03020000"), (6, "03020000"), (5, "830A")] {
        assert_eq!(ask(&mut device, &mut image, unit, "03 0000 0001"), answer, "{unit}");
    }
}

#[test]
fn a_broadcast_is_carried_out_once_a_map_and_never_answered() {
    let mut image = MemoryImage::new(10);
    let mut device = line(&[(5, 0), (6, 0), (7, 1)]);
    assert_eq!(ask(&mut device, &mut image, 0, "06 0001 1234"), "");
    assert_eq!((image.holding[1], image.writes, image.selected.as_slice()), (0x1234, 2, &[0, 1][..]));
    assert_eq!(ask(&mut device, &mut image, 0, "03 0001 0001"), "");
    assert_eq!(ask(&mut device, &mut image, 0, "09"), "");
    // Every unit counted them: messages processed, no response; the exception counts too.
    for unit in [5, 6, 7] {
        assert_eq!(ask(&mut device, &mut image, unit, "08 000F 0000"), "08000F0003", "{unit}");
        assert_eq!(ask(&mut device, &mut image, unit, "08 000D 0000"), "08000D0001", "{unit}");
    }
}

#[test]
fn listen_only_is_the_matter_of_one_unit() {
    let mut image = MemoryImage::new(10);
    let mut device = line(&[(5, 0), (6, 0)]);
    assert_eq!(ask(&mut device, &mut image, 5, "08 0004 0000"), "");
    assert_eq!(ask(&mut device, &mut image, 5, "06 0001 0001"), "");
    assert_eq!(image.writes, 0);
    assert_eq!(ask(&mut device, &mut image, 6, "06 0001 0001"), "0600010001");
    // A broadcast is carried out by the other one.
    assert_eq!(ask(&mut device, &mut image, 0, "06 0001 0002"), "");
    assert_eq!((image.holding[1], image.writes), (2, 2));
    // Restart brings it back, without an answer; then it answers one.
    assert_eq!(ask(&mut device, &mut image, 5, "08 0001 0000"), "");
    assert_eq!(ask(&mut device, &mut image, 5, "08 0001 FF00"), "080001FF00");
    assert_eq!(ask(&mut device, &mut image, 5, "0C"), "0C09000000010001804000");
}

#[test]
fn counters_tell_of_the_line_and_of_the_unit() {
    let mut image = MemoryImage::new(10);
    let mut device = line(&[(5, 0), (6, 0)]);
    ask(&mut device, &mut image, 5, "03 0000 0001");
    ask(&mut device, &mut image, 5, "03 0063 0001");
    ask(&mut device, &mut image, 9, "03 0000 0001");
    device.fault(LineFault::Damaged);
    device.fault(LineFault::Overrun);
    image.busy = true;
    assert_eq!(ask(&mut device, &mut image, 5, "06 0000 0001"), "8606");
    // Each of these requests is a message on the line itself.
    for (unit, sub, value) in [
        (5, "0B", 5),
        (5, "0C", 1),
        (5, "0D", 2),
        (5, "0E", 6),
        (5, "0F", 0),
        (5, "10", 0),
        (5, "11", 1),
        (5, "12", 1),
        (6, "0B", 13),
        (6, "0C", 1),
        (6, "0D", 0),
        (6, "0E", 3),
        (6, "12", 1),
    ] {
        let got = ask(&mut device, &mut image, unit, &format!("08 00{sub} 0000"));
        assert_eq!(got, format!("0800{sub}{value:04X}"), "unit {unit}");
    }
    // Events: one good read and eight diagnostics; function 11 itself and 12 do not count.
    assert_eq!(ask(&mut device, &mut image, 5, "0B"), "0B00000009");
    assert_eq!(ask(&mut device, &mut image, 5, "0B"), "0B00000009");
    assert_eq!(ask(&mut device, &mut image, 5, "08 000A 0000"), "08000A0000");
    assert_eq!(ask(&mut device, &mut image, 5, "0B"), "0B00000001");
    assert_eq!(ask(&mut device, &mut image, 6, "08 000C 0000"), "08000C0001", "the other unit keeps its own");
}

#[test]
fn serial_codes_and_rights() {
    let mut image = MemoryImage::new(10);
    let rights = r#"[ { "units": [2], "allow": "read" }, { "functions": [43], "allow": "nothing" } ]"#;
    let rights = Rights::new(&serde_json::from_str::<Vec<RightsEntry>>(rights).unwrap(), &[]).unwrap();
    let identity = IdentityConfig::default().build().unwrap();
    let shared = Shared { identity: Rc::new(identity), rights: Rc::new(rights), serial_codes_on_tcp: false };
    let mut tcp = Device::tcp(None, &[], shared.clone());
    for code in ["07", "08 0000 0000", "0B", "0C", "11"] {
        let refused = format!("{:02X}01", hex(code)[0] | 0x80);
        assert_eq!(ask(&mut tcp, &mut image, 1, code), refused);
    }
    assert_eq!(ask(&mut tcp, &mut image, 1, "2B 0E 01 00"), "AB01");
    assert_eq!(ask(&mut tcp, &mut image, 2, "06 0000 0001"), "8601");
    assert_eq!(ask(&mut tcp, &mut image, 2, "03 0000 0001"), "03020000");
    assert_eq!(ask(&mut tcp, &mut image, 3, "06 0000 0001"), "0600000001");
    let mut line = Device::line(&[(1, 0)], false, shared);
    assert_eq!(ask(&mut line, &mut image, 1, "07"), "076D");
}

fn with_rights(units: &[(u8, usize)], answer_255: bool, rights: &str) -> Device {
    let rights = Rights::new(&serde_json::from_str::<Vec<RightsEntry>>(rights).unwrap(), &[]).unwrap();
    Device::line(units, answer_255, Shared { rights: Rc::new(rights), ..Shared::open() })
}

#[test]
fn what_a_unit_may_not_do_it_does_not_do_under_another_number_either() {
    // Unit 5 is read only: neither a broadcast nor "any" gets around that.
    let mut image = MemoryImage::new(10);
    let mut device = with_rights(&[(5, 0), (6, 1)], true, r#"[ { "units": [5], "allow": "read" } ]"#);
    assert_eq!(ask(&mut device, &mut image, 5, "06 0001 0001"), "8601");
    assert_eq!(ask(&mut device, &mut image, 255, "06 0001 0001"), "8601");
    assert_eq!(ask(&mut device, &mut image, 255, "03 0001 0001"), "03020000");
    image.selected.clear();
    assert_eq!(ask(&mut device, &mut image, 0, "06 0001 0001"), "");
    assert_eq!((image.writes, image.selected.as_slice()), (1, &[1][..]), "unit 6 alone");
    // A unit with the same map that may is not kept from it by one that may not, and once is enough.
    let mut device =
        with_rights(&[(5, 0), (6, 0), (7, 0)], false, r#"[ { "units": [5], "allow": "read" } ]"#);
    let writes = image.writes;
    assert_eq!(ask(&mut device, &mut image, 0, "06 0001 0002"), "");
    assert_eq!((image.writes, image.holding[1]), (writes + 1, 2));
    // Broadcasts themselves can be forbidden, with 0 as the unit.
    let mut device = with_rights(&[(5, 0)], false, r#"[ { "units": [0], "allow": "nothing" } ]"#);
    assert_eq!(ask(&mut device, &mut image, 0, "06 0001 0003"), "");
    assert_eq!(ask(&mut device, &mut image, 5, "03 0001 0001"), "03020002");
}
