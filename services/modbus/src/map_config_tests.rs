use super::*;
use insta::assert_snapshot;

const SIZES: AreaSizes = AreaSizes { input: 64, output: 64, marker: 64 };

fn parse(json: &str) -> MapConfig {
    serde_json::from_str(json).unwrap()
}

fn error(json: &str) -> String {
    parse(json).build(SIZES, Addressing::Element).unwrap_err().to_string()
}

#[test]
fn the_key_is_a_name_or_tables() {
    assert_eq!(parse("\"dinrail\""), MapConfig::Preset(Preset::Dinrail));
    assert_eq!(parse("\"openplc\""), MapConfig::Preset(Preset::Openplc));
    let MapConfig::Tables(entries) =
        parse(r#"[{ "table": "holding", "at": 0, "count": 2, "area": "%MD0", "word_order": "high_first" }]"#)
    else {
        panic!("tables")
    };
    assert_eq!(
        (entries[0].table, entries[0].word_order),
        (Table::HoldingRegisters, Some(WordOrder::HighFirst))
    );
    let bad = |json| serde_json::from_str::<MapConfig>(json).unwrap_err().to_string();
    assert_snapshot!(bad("\"mine\""), @r#"there is no map 'mine': write "dinrail", "openplc", or [[service.map]] tables at line 1 column 6"#);
    assert_snapshot!(bad("7"), @r#"invalid type: integer `7`, expected "dinrail", "openplc", or [[service.map]] tables at line 1 column 1"#);
    assert_snapshot!(bad(r#"[{ "table": "holding", "at": 0, "count": 1, "aera": "%MW0" }]"#), @"unknown field `aera`, expected one of `table`, `at`, `count`, `area`, `word_order`, `swap_bytes`, `order`, `own`, `read_only` at line 1 column 50");
}

#[test]
fn every_mistake_names_the_table_and_the_remedy() {
    let table = |rest: &str| {
        error(&format!(r#"[{{ "table": "holding", "at": 0, "count": 1, "area": "%MW0" }}, {{ {rest} }}]"#))
    };
    assert_snapshot!(table(r#""table": "holding", "at": 1, "count": 0, "area": "%MW0""#), @"map table 2: count is 0; leave the table out or give it at least 1");
    assert_snapshot!(table(r#""table": "holding", "at": 65535, "count": 2, "area": "%MW0""#), @"map table 2: holding_registers 65535 to 65536 does not fit; Modbus addresses end at 65535");
    assert_snapshot!(table(r#""table": "holding", "at": 1, "count": 2, "area": "%MW31""#), @"map table 2: holding_registers 1 to 2 reaches byte 66 of %M, which has 64; lower count or raise the size of %M in the plc service");
    assert_snapshot!(table(r#""table": "coils", "at": 1, "count": 2, "area": "%QW0""#), @"map table 2: coils shows single bits, so area must be %QX... or %QB...; got %QW0");
    assert_snapshot!(table(r#""table": "input", "at": 1, "count": 2, "area": "%IX0.0""#), @"map table 2: input_registers shows 16-bit words, so area must be %IB, W, D or L; got %IX0.0");
    assert_snapshot!(table(r#""table": "input", "at": 1, "count": 2, "area": "%IX0.9""#), @"map table 2: `%IX0.9`: a byte has the bits 0 to 7; bit 9 of byte 0 is %IX1.1");
    assert_snapshot!(table(r#""table": "input", "at": 1, "count": 2, "area": "%IW0", "word_order": "high_first""#), @"map table 2: word_order needs values of 32 or 64 bits; write area as %xD or %xL, got %IW0");
    assert_snapshot!(table(r#""table": "input", "at": 1, "count": 3, "area": "%ID0""#), @"map table 2: count 3 splits a value; %xD needs a multiple of 2, %xL of 4");
    assert_snapshot!(table(r#""table": "coils", "at": 1, "count": 3, "area": "%QX0.0", "swap_bytes": true"#), @"map table 2: order and swap_bytes are for registers, coils shows single bits");
    assert_snapshot!(table(r#""table": "holding", "at": 1, "count": 2, "area": "%QD0", "order": "AB""#), @"map table 2: order AB is for values of 16 bits, but %QD0 has others; write AB or BA for %xW, ABCD, CDAB, BADC or DCBA for %xD and %xL");
    assert_snapshot!(table(r#""table": "holding", "at": 1, "count": 2, "area": "%QW0", "order": "CDAB""#), @"map table 2: order CDAB is for values of 32 or 64 bits, but %QW0 has others; write AB or BA for %xW, ABCD, CDAB, BADC or DCBA for %xD and %xL");
    assert_snapshot!(table(r#""table": "holding", "at": 1, "count": 2, "area": "%QD0", "order": "CDAB", "swap_bytes": true"#), @"map table 2: order says what word_order and swap_bytes say; keep one of them");
    assert_snapshot!(table(r#""table": "holding", "at": 1, "count": 2, "area": "%IW0", "own": true, "read_only": true"#), @"map table 2: own = true lets clients write what read_only = true forbids; keep one of them");
    assert_snapshot!(table(r#""table": "holding", "at": 1, "count": 3, "area": "%QW0", "own": true"#), @"map table 2: own = true is for %I in coils or holding_registers, which clients can write; got %QW0 in holding_registers");
    assert_snapshot!(table(r#""table": "input", "at": 1, "count": 3, "area": "%IW0", "own": true"#), @"map table 2: own = true is for %I in coils or holding_registers, which clients can write; got %IW0 in input_registers");
    assert_snapshot!(table(r#""table": "coils", "at": 1, "count": 3, "area": "%IX0.0", "own": true"#), @"map table 2: bits of %I owned by the server are owned by whole bytes; begin at bit 0 and give a multiple of 8");
    assert_snapshot!(table(r#""table": "holding", "at": 0, "count": 3, "area": "%QW0""#), @"map tables 1 and 2 both show holding_registers 0; a register has one place");
}

#[test]
fn rows_show_addresses_numbers_and_rights() {
    let text = |map: &RegisterMap, addressing| {
        map.rows(addressing)
            .iter()
            .map(|row| {
                format!(
                    "{} {}-{} ({}-{}) {}..{} {}\n",
                    row.table.name(),
                    row.first,
                    row.last,
                    row.first_number,
                    row.last_number,
                    row.first_address,
                    row.last_address,
                    if row.writable { "rw" } else { "r" },
                )
            })
            .collect::<Vec<_>>()
            .concat()
    };
    let map = RegisterMap::preset(Preset::Dinrail, AreaSizes::default(), Addressing::Element);
    assert_snapshot!(text(&map, Addressing::Element), @r#"
coils 0-32767 (00001-032768) %QX0.0..%QX4095.7 rw
discrete_inputs 0-32767 (10001-132768) %IX0.0..%IX4095.7 r
input_registers 0-2047 (30001-32048) %IW0..%IW2047 r
holding_registers 0-2047 (40001-42048) %MW0..%MW2047 rw
holding_registers 32768-34815 (432769-434816) %QW0..%QW2047 rw
"#);
    let mut map = RegisterMap::preset(Preset::Openplc, AreaSizes::MAX, Addressing::OpenPlc);
    map.set_sizes(AreaSizes { marker: 8192, ..AreaSizes::default() });
    assert_snapshot!(text(&map, Addressing::OpenPlc), @r#"
coils 0-8191 (00001-08192) %QX0.0..%QX1023.7 rw
discrete_inputs 0-8191 (10001-18192) %IX0.0..%IX1023.7 r
input_registers 0-1023 (30001-31024) %IW0..%IW1023 r
holding_registers 0-1023 (40001-41024) %QW0..%QW1023 rw
holding_registers 1024-2047 (41025-42048) %MW0..%MW1023 rw
holding_registers 2048-4095 (42049-44096) %MD0..%MD1023 rw
"#);
}

#[test]
fn rows_of_values_that_no_address_names_show_the_first_byte() {
    let map = |area: &str, addressing| {
        let table = format!(r#"[{{ "table": "holding", "at": 0, "count": 4, "area": "{area}" }}]"#);
        let rows = parse(&table).build(AreaSizes::MAX, addressing).unwrap().rows(addressing);
        (rows[0].first_address.clone(), rows[0].last_address.clone())
    };
    let texts = |first: &str, last: &str| (first.to_owned(), last.to_owned());
    assert_eq!(map("%MB3", Addressing::Element), texts("%MB3", "%MB9"));
    assert_eq!(map("%MW3", Addressing::Byte), texts("%MW3", "%MW9"));
    assert_eq!(map("%MW1", Addressing::OpenPlc), texts("%MW1", "%MW4"));
    assert_eq!(map("%MB1", Addressing::OpenPlc), texts("%MB1", "%MB7"));
}

#[test]
fn traditional_numbers() {
    for (table, address, number) in [
        (Table::Coils, 0, "00001"),
        (Table::DiscreteInputs, 9, "10010"),
        (Table::InputRegisters, 9998, "39999"),
        (Table::HoldingRegisters, 9999, "410000"),
        (Table::HoldingRegisters, 65535, "465536"),
    ] {
        assert_eq!(traditional_number(table, address), number);
    }
}

#[test]
fn entries_of_a_place_are_found() {
    let map = RegisterMap::preset(Preset::Dinrail, SIZES, Addressing::Element);
    let at = |text| {
        let at = parse_address(text, Addressing::Element).unwrap();
        map.entries_at(area_of(at), at.byte, at.bit)
    };
    assert_eq!(at("%MW3"), [(Table::HoldingRegisters, 3)]);
    assert_eq!(at("%MD3"), [(Table::HoldingRegisters, 6)]);
    assert_eq!(at("%QW1"), [(Table::HoldingRegisters, 32769)]);
    assert_eq!(at("%IB3"), [(Table::InputRegisters, 1)]);
    assert_eq!(at("%QX2.5"), [(Table::Coils, 21)]);
    assert_eq!(at("%IX63.7"), [(Table::DiscreteInputs, 511)]);
    assert_eq!(at("%MX0.0"), []);
    assert_eq!(at("%MW32"), []);
    let map = parse(
        r#"[{ "table": "holding", "at": 100, "count": 4, "area": "%MD1", "word_order": "high_first" }]"#,
    )
    .build(SIZES, Addressing::Element)
    .unwrap();
    let at = |text| {
        let at = parse_address(text, Addressing::Element).unwrap();
        map.entries_at(area_of(at), at.byte, at.bit)
    };
    assert_eq!((at("%MD2"), at("%MD0")), (vec![(Table::HoldingRegisters, 102)], vec![]));
}
