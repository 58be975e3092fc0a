use super::*;
use crate::map_config::{MapEntry, WordOrder};
use proptest::prelude::*;

const SIZES: AreaSizes = AreaSizes { input: 64, output: 64, marker: 64 };

fn entry(table: Table, at: u32, count: u32, area: &str) -> MapEntry {
    MapEntry {
        table,
        at,
        count,
        area: area.to_owned(),
        word_order: None,
        swap_bytes: false,
        order: None,
        own: false,
        read_only: false,
    }
}

fn map(entries: &[MapEntry]) -> RegisterMap {
    RegisterMap::from_entries(entries, SIZES, Addressing::Element).unwrap()
}

fn words(map: &RegisterMap, memory: &Memory<'_>, table: Table, address: u16, n: usize) -> Vec<u16> {
    let mut out = vec![0; n * 2];
    map.read_words(memory, table, address, &mut out).unwrap();
    out.chunks(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
}

/// Plans a write and applies it to a copy of %M.
fn written(map: &RegisterMap, write: &Write<'_>, marker: &[u8]) -> Vec<u8> {
    let mut set = WriteSet::default();
    assert_eq!(map.plan(write, &mut set), Ok(Destination::Plc));
    let mut bytes = marker.to_vec();
    for run in set.runs() {
        assert_eq!(run.area, Area::Marker);
        assert!(run.op().apply(&mut bytes));
    }
    bytes
}

#[test]
fn the_default_map_shows_words_high_byte_first_and_ends_with_the_areas() {
    let map = RegisterMap::preset(Preset::Dinrail, SIZES, Addressing::Element);
    let (marker, output, input) = ([0x34, 0x12, 0x78, 0x56], [0x01, 0xA0], [0xCD, 0xAB]);
    let memory = Memory { input: &input, output: &output, marker: &marker, own_input: &[] };
    assert_eq!(words(&map, &memory, Table::HoldingRegisters, 0, 2), [0x1234, 0x5678]);
    assert_eq!(words(&map, &memory, Table::HoldingRegisters, 32768, 1), [0xA001]);
    assert_eq!(words(&map, &memory, Table::InputRegisters, 0, 2), [0xABCD, 0]);
    let mut bits = [0; 2];
    map.read_bits(&memory, Table::Coils, 0, 13, &mut bits).unwrap();
    assert_eq!(bits, [0x01, 0x00]);
    map.read_bits(&memory, Table::DiscreteInputs, 4, 12, &mut bits).unwrap();
    assert_eq!(bits, [0xBC, 0x0A]);
    for (table, address, quantity, ok) in [
        (Table::HoldingRegisters, 0, 32, true),
        (Table::HoldingRegisters, 0, 33, false),
        (Table::HoldingRegisters, 31, 1, true),
        (Table::HoldingRegisters, 32767, 2, false),
        (Table::HoldingRegisters, 32768, 32, true),
        (Table::HoldingRegisters, 32800, 1, false),
        (Table::HoldingRegisters, 65535, 125, false),
        (Table::Coils, 511, 1, true),
        (Table::Coils, 511, 2, false),
        (Table::DiscreteInputs, 0, 512, true),
        (Table::InputRegisters, 32, 1, false),
    ] {
        let expected = if ok { Ok(()) } else { Err(Exception::IllegalDataAddress) };
        assert_eq!(
            map.check(Access::Read, table, address, quantity),
            expected,
            "{table:?} {address} {quantity}"
        );
    }
}

#[test]
fn the_largest_areas_fill_the_default_map() {
    let map = RegisterMap::preset(Preset::Dinrail, AreaSizes::MAX, Addressing::Element);
    assert_eq!(
        map.check(Access::Write, Table::HoldingRegisters, 32700, 123),
        Ok(()),
        "crosses from %M to %Q"
    );
    assert_eq!(map.check(Access::Read, Table::HoldingRegisters, 65535, 1), Ok(()));
    assert_eq!(map.check(Access::Read, Table::Coils, 65535, 1), Ok(()));
    assert_eq!(map.check(Access::Read, Table::Coils, 65535, 2), Err(Exception::IllegalDataAddress));
}

#[test]
fn the_openplc_map_has_its_values_high_word_first() {
    let map = RegisterMap::preset(Preset::Openplc, AreaSizes::MAX, Addressing::OpenPlc);
    let mut marker = vec![0; 65536];
    marker[1024..1026].copy_from_slice(&7_u16.to_le_bytes());
    marker[4096..4100].copy_from_slice(&0x1122_3344_u32.to_le_bytes());
    marker[8192..8200].copy_from_slice(&0x1122_3344_5566_7788_u64.to_le_bytes());
    let mut output = vec![0; 65536];
    output[0] = 0b100;
    output[1024..1026].copy_from_slice(&9_u16.to_le_bytes());
    let memory = Memory { output: &output, marker: &marker, ..Memory::default() };
    let read = |address, n| words(&map, &memory, Table::HoldingRegisters, address, n);
    assert_eq!(read(0, 1), [9]);
    assert_eq!(read(1024, 1), [7]);
    assert_eq!(read(2048, 2), [0x1122, 0x3344]);
    assert_eq!(read(2049, 1), [0x3344]);
    assert_eq!(read(4096, 4), [0x1122, 0x3344, 0x5566, 0x7788]);
    assert_eq!(map.check(Access::Read, Table::HoldingRegisters, 8191, 1), Ok(()));
    assert_eq!(map.check(Access::Read, Table::HoldingRegisters, 8192, 1), Err(Exception::IllegalDataAddress));
    let mut bits = [0];
    map.read_bits(&memory, Table::Coils, 2, 1, &mut bits).unwrap();
    assert_eq!(bits, [1]);
}

#[test]
fn areas_smaller_than_the_map_are_exception_2_beyond_their_end() {
    let mut map = RegisterMap::preset(Preset::Dinrail, AreaSizes::MAX, Addressing::Element);
    assert_eq!(map.check(Access::Read, Table::HoldingRegisters, 0, 125), Ok(()));
    map.set_sizes(AreaSizes { input: 1, output: 4, marker: 20 });
    for (table, address, quantity, ok) in [
        (Table::HoldingRegisters, 0, 10, true),
        (Table::HoldingRegisters, 9, 2, false),
        (Table::HoldingRegisters, 32768, 3, false),
        (Table::InputRegisters, 0, 1, false),
        (Table::DiscreteInputs, 0, 8, true),
        (Table::DiscreteInputs, 7, 2, false),
        (Table::Coils, 31, 1, true),
    ] {
        assert_eq!(
            map.check(Access::Read, table, address, quantity).is_ok(),
            ok,
            "{table:?} {address} {quantity}"
        );
    }
}

#[test]
fn word_order_and_bytes() {
    let entries = [
        MapEntry { word_order: Some(WordOrder::HighFirst), ..entry(Table::HoldingRegisters, 10, 4, "%MD0") },
        MapEntry { swap_bytes: true, ..entry(Table::HoldingRegisters, 20, 2, "%MW0") },
        MapEntry { word_order: Some(WordOrder::LowFirst), ..entry(Table::HoldingRegisters, 30, 2, "%MD0") },
    ];
    let map = map(&entries);
    let marker = [0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08];
    let memory = Memory { marker: &marker, ..Memory::default() };
    let read = |address, n| words(&map, &memory, Table::HoldingRegisters, address, n);
    assert_eq!(read(10, 4), [0x0403, 0x0201, 0x0807, 0x0605]);
    assert_eq!(read(11, 2), [0x0201, 0x0807]);
    assert_eq!(read(20, 2), [0x0102, 0x0304]);
    assert_eq!(read(30, 2), [0x0201, 0x0403]);

    let write = Write::Registers { address: 11, values: &[0xAA, 0xBB, 0xCC, 0xDD] };
    assert_eq!(written(&map, &write, &marker), [0xBB, 0xAA, 3, 4, 5, 6, 0xDD, 0xCC]);
    let write = Write::Mask { address: 20, and_mask: 0xFF00, or_mask: 0x0055 };
    assert_eq!(written(&map, &write, &marker)[..2], [0x01, 0x55]);
}

#[test]
fn a_write_of_whole_values_high_word_first_is_one_run() {
    let map = map(&[MapEntry {
        word_order: Some(WordOrder::HighFirst),
        ..entry(Table::HoldingRegisters, 0, 32, "%MD0")
    }]);
    let mut set = WriteSet::default();
    map.plan(&Write::Registers { address: 0, values: &[0; 64] }, &mut set).unwrap();
    assert_eq!(set.runs().count(), 1);
    map.plan(&Write::Registers { address: 1, values: &[0; 60] }, &mut set).unwrap();
    assert_eq!(set.runs().count(), 3);
}

#[test]
fn coils_keep_their_neighbours() {
    let map = map(&[entry(Table::Coils, 100, 20, "%MX0.3")]);
    let write = Write::Coils { address: 101, quantity: 10, values: &[0b1010_1010, 0b10] };
    // Bits 4 to 13 of %M, from all ones.
    assert_eq!(written(&map, &write, &[0xFF; 3]), [0b1010_1111, 0b1110_1010, 0xFF]);
    let off = Write::Coils { address: 119, quantity: 1, values: &[0] };
    assert_eq!(written(&map, &off, &[0xFF; 3]), [0xFF, 0xFF, 0b1011_1111]);
}

#[test]
fn mask_write_follows_the_formula() {
    let map = RegisterMap::preset(Preset::Dinrail, SIZES, Addressing::Element);
    let write = Write::Mask { address: 1, and_mask: 0x00F2, or_mask: 0x0025 };
    assert_eq!(written(&map, &write, &[0, 0, 0x12, 0x00])[2..], [0x17, 0x00]);
}

#[test]
fn requests_cross_ranges_but_not_gaps() {
    let map = map(&[
        entry(Table::HoldingRegisters, 0, 2, "%MW4"),
        entry(Table::HoldingRegisters, 2, 2, "%QW0"),
        entry(Table::HoldingRegisters, 5, 1, "%MW0"),
    ]);
    let memory =
        Memory { output: &[9, 0, 8, 0], marker: &[1, 0, 0, 0, 0, 0, 0, 0, 5, 0, 6, 0], ..Memory::default() };
    assert_eq!(words(&map, &memory, Table::HoldingRegisters, 0, 4), [5, 6, 9, 8]);
    assert_eq!(map.check(Access::Write, Table::HoldingRegisters, 1, 3), Ok(()));
    for (address, quantity) in [(3, 2), (4, 1), (4, 2), (6, 1), (0, 6)] {
        let check = map.check(Access::Read, Table::HoldingRegisters, address, quantity);
        assert_eq!(check, Err(Exception::IllegalDataAddress), "{address} {quantity}");
    }
}

#[test]
fn inputs_are_read_only_unless_the_server_owns_them() {
    let own = MapEntry { own: true, ..entry(Table::HoldingRegisters, 2, 2, "%IW2") };
    let map = map(&[
        entry(Table::HoldingRegisters, 0, 2, "%IW0"),
        own,
        entry(Table::HoldingRegisters, 4, 2, "%MW0"),
    ]);
    let refused = Err(Exception::IllegalDataAddress);
    let write = |address, quantity| map.check(Access::Write, Table::HoldingRegisters, address, quantity);
    assert_eq!(map.check(Access::Read, Table::HoldingRegisters, 0, 6), Ok(()));
    assert_eq!(
        (write(0, 1), write(1, 2), write(2, 2), write(3, 2), write(4, 2)),
        (refused, refused, Ok(()), refused, Ok(()))
    );
    assert_eq!(map.own_inputs(), [(4, 4)]);
    let mut set = WriteSet::default();
    let plan = map.plan(&Write::Registers { address: 2, values: &[1, 2] }, &mut set);
    assert_eq!(plan, Ok(Destination::OwnInputs));
    assert_eq!(
        set.runs().next().map(|run| (run.area, run.offset, run.or.to_vec())),
        Some((Area::Input, 4, vec![2, 1]))
    );
    // What the server wrote last is read back, not what the PLC has taken so far.
    let memory = Memory { input: &[7; 8], own_input: &[0, 0, 0, 0, 2, 1], ..Memory::default() };
    assert_eq!(words(&map, &memory, Table::HoldingRegisters, 1, 2), [0x0707, 0x0102]);
}

#[test]
fn a_write_to_too_many_places_is_refused_whole() {
    let entries: Vec<_> =
        (0..30).map(|i| entry(Table::HoldingRegisters, i, 1, &format!("%MW{}", 29 - i))).collect();
    let map = map(&entries);
    let mut set = WriteSet::default();
    let n = crate::write_set::MAX_RUNS;
    assert!(map.plan(&Write::Registers { address: 0, values: &vec![0; n * 2] }, &mut set).is_ok());
    let plan = map.plan(&Write::Registers { address: 0, values: &vec![0; n * 2 + 2] }, &mut set);
    assert_eq!(plan, Err(Exception::ServerDeviceFailure));
}

proptest! {
    /// Bits of any range, read against a bit-by-bit oracle.
    #[test]
    fn bits_are_where_they_belong(
        input in proptest::collection::vec(any::<u8>(), 64), first in 0_u32..8, at in 0_u16..390, quantity in 1_u16..100,
    ) {
        let map = map(&[entry(Table::DiscreteInputs, 0, 490, &format!("%IX1.{first}"))]);
        let memory = Memory { input: &input, ..Memory::default() };
        let mut out = [0xFF; 13];
        let n = usize::from(quantity).div_ceil(8);
        map.read_bits(&memory, Table::DiscreteInputs, at, quantity, &mut out[..n]).unwrap();
        for i in 0..n * 8 {
            let bit = 8 + first as usize + usize::from(at) + i;
            let expected = if i < usize::from(quantity) { input[bit / 8] >> (bit % 8) & 1 } else { 0 };
            prop_assert_eq!(out[i / 8] >> (i % 8) & 1, expected, "bit {}", i);
        }
    }

    /// Whatever the order of words and bytes, what is written is read back and nothing else changes.
    #[test]
    fn registers_written_are_registers_read(
        before in proptest::collection::vec(any::<u8>(), 64), values in proptest::collection::vec(any::<u8>(), 2..32),
        at in 0_u16..8, high_first: bool, swap_bytes: bool, width in 0..3_usize,
    ) {
        let values = &values[..values.len() / 2 * 2];
        let area = ["%MW0", "%MD0", "%ML0"][width];
        let word_order = (width > 0 && high_first).then_some(WordOrder::HighFirst);
        let map = map(&[MapEntry { word_order, swap_bytes, ..entry(Table::HoldingRegisters, 0, 32, area) }]);
        let after = written(&map, &Write::Registers { address: at, values }, &before);
        let (old, new) = (Memory { marker: &before, ..Memory::default() }, Memory { marker: &after, ..Memory::default() });
        let mut expected = words(&map, &old, Table::HoldingRegisters, 0, 32);
        for (i, pair) in values.chunks(2).enumerate() {
            expected[usize::from(at) + i] = u16::from_be_bytes([pair[0], pair[1]]);
        }
        prop_assert_eq!(words(&map, &new, Table::HoldingRegisters, 0, 32), expected);
    }

    #[test]
    fn coils_written_are_coils_read(
        before in proptest::collection::vec(any::<u8>(), 64), packed in proptest::collection::vec(any::<u8>(), 32),
        first in 0_u32..8, at in 0_u16..200, quantity in 1_u16..=256,
    ) {
        let map = map(&[entry(Table::Coils, 0, 490, &format!("%MX1.{first}"))]);
        let n = usize::from(quantity).div_ceil(8);
        let after = written(&map, &Write::Coils { address: at, quantity, values: &packed[..n] }, &before);
        for bit in 0..512_usize {
            let i = bit as i64 - 8 - i64::from(first) - i64::from(at);
            let source = if (0..i64::from(quantity)).contains(&i) { (&packed, i as usize) } else { (&before, bit) };
            prop_assert_eq!(after[bit / 8] >> (bit % 8) & 1, source.0[source.1 / 8] >> (source.1 % 8) & 1, "bit {}", bit);
        }
    }
}

#[test]
fn orders_of_bytes_and_read_only_windows() {
    use crate::map_config::ByteOrder;
    // DWORD 0A0B0C0Dh, WORD 0A0Bh, as they lie in memory.
    let marker = [0x0D, 0x0C, 0x0B, 0x0A, 0, 0, 0, 0];
    for (order, area, count, wire) in [
        (ByteOrder::Abcd, "%MD0", 2, &[0x0A, 0x0B, 0x0C, 0x0D][..]),
        (ByteOrder::Cdab, "%MD0", 2, &[0x0C, 0x0D, 0x0A, 0x0B]),
        (ByteOrder::Badc, "%MD0", 2, &[0x0B, 0x0A, 0x0D, 0x0C]),
        (ByteOrder::Dcba, "%MD0", 2, &[0x0D, 0x0C, 0x0B, 0x0A]),
        (ByteOrder::Ab, "%MW0", 1, &[0x0C, 0x0D]),
        (ByteOrder::Ba, "%MW0", 1, &[0x0D, 0x0C]),
    ] {
        let map = map(&[MapEntry { order: Some(order), ..entry(Table::HoldingRegisters, 0, count, area) }]);
        let mut out = vec![0; wire.len()];
        let memory = Memory { marker: &marker, ..Memory::default() };
        map.read_words(&memory, Table::HoldingRegisters, 0, &mut out).unwrap();
        assert_eq!(out, wire, "{order:?}");
        // What is written that way is the same value in memory.
        let mut set = WriteSet::default();
        map.plan(&Write::Registers { address: 0, values: wire }, &mut set).unwrap();
        let mut written = [0; 8];
        for run in set.runs() {
            assert!(run.op().apply(&mut written));
        }
        assert_eq!(written[..wire.len()], marker[..wire.len()], "{order:?}");
    }
    let map = map(&[
        MapEntry { read_only: true, ..entry(Table::HoldingRegisters, 0, 2, "%MW0") },
        entry(Table::HoldingRegisters, 2, 2, "%MW2"),
    ]);
    let check = |access, at, n| map.check(access, Table::HoldingRegisters, at, n).is_ok();
    assert!(check(Access::Read, 0, 4) && check(Access::Write, 2, 2));
    assert!(!check(Access::Write, 0, 1) && !check(Access::Write, 1, 2));
}
