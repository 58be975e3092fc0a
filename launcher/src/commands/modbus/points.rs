//! Points as they are written on the command line, and their values.

use super::PointArgs;
use crate::commands::UsageError;
use dinrail_modbus::client::order::Order;
use dinrail_modbus::map_config::traditional_number;
use dinrail_modbus::server::Table;
use serde_json::{Value, json};

/// How registers are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ValueType {
    Int(usize),
    Uint(usize),
    Float(usize),
    Bit,
    Hex,
    /// Two characters a register, the high byte first.
    Text,
}

impl ValueType {
    /// From its name.
    pub fn parse(name: &str) -> Result<Self, String> {
        Ok(match name.to_ascii_lowercase().as_str() {
            "int16" | "int" | "i16" => Self::Int(1),
            "int32" | "dint" | "i32" => Self::Int(2),
            "int64" | "lint" | "i64" => Self::Int(4),
            "uint16" | "uint" | "u16" => Self::Uint(1),
            "uint32" | "udint" | "u32" => Self::Uint(2),
            "uint64" | "ulint" | "u64" => Self::Uint(4),
            "float" | "real" | "f32" => Self::Float(2),
            "double" | "lreal" | "f64" => Self::Float(4),
            "bit" | "bool" => Self::Bit,
            "hex" => Self::Hex,
            "string" | "text" => Self::Text,
            _ => {
                return Err(format!(
                    "'{name}' is none of int16, uint16, int32, uint32, int64, uint64, float, double, bit, hex, string"
                ));
            }
        })
    }

    /// What a value of it looks like.
    fn words(self) -> String {
        match self {
            Self::Int(n) => {
                let most = 1i128 << (n * 16 - 1);
                format!("whole numbers from {} to {}", -most, most - 1)
            }
            Self::Uint(n) => format!("whole numbers from 0 to {}", (1i128 << (n * 16)) - 1),
            Self::Float(_) => "numbers like 1.5".to_owned(),
            Self::Bit => "on or off, true or false, 1 or 0".to_owned(),
            Self::Hex => "up to four hexadecimal digits".to_owned(),
            Self::Text => "text".to_owned(),
        }
    }

    /// Registers of one value.
    pub fn registers(self) -> usize {
        match self {
            Self::Int(n) | Self::Uint(n) | Self::Float(n) => n,
            Self::Bit | Self::Hex | Self::Text => 1,
        }
    }
}

pub fn parse_table(name: &str) -> Result<Table, String> {
    serde_json::from_value(json!(name)).map_err(|_| {
        format!("'{name}' is none of coils, discrete_inputs, input_registers, holding_registers")
    })
}

pub fn parse_order(name: &str) -> Result<Order, String> {
    Order::from_name(name).ok_or_else(|| format!("'{name}' is none of {}", Order::NAMES.join(", ")))
}

/// A point to read.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    pub name: Option<String>,
    pub table: Table,
    pub at: u16,
    /// Values.
    pub count: u16,
    pub value_type: ValueType,
    pub order: Order,
}

impl Point {
    /// Bits or registers.
    pub fn entries(&self) -> u16 {
        self.count * self.value_type.registers() as u16
    }

    /// How its registers are read or written: `float ABCD`, or the type alone where there is no order to speak of.
    pub fn form(&self) -> String {
        let name = match self.value_type {
            ValueType::Int(n) => format!("int{}", n * 16),
            ValueType::Uint(n) => format!("uint{}", n * 16),
            ValueType::Float(2) => "float".to_owned(),
            ValueType::Float(_) => "double".to_owned(),
            ValueType::Bit => "bit".to_owned(),
            ValueType::Hex => "hex".to_owned(),
            ValueType::Text => "string".to_owned(),
        };
        if self.value_type.registers() > 1 || self.order != Order::default() {
            format!("{name} {}", self.order.name())
        } else {
            name
        }
    }

    /// The traditional number of a value.
    pub fn number(&self, value: usize) -> String {
        traditional_number(self.table, self.at + (value * self.value_type.registers()) as u16)
    }
}

fn usage(text: impl Into<String>) -> UsageError {
    UsageError(text.into())
}

/// Table and 0-based address of a number.
fn address(text: &str, table: Option<Table>) -> Result<(Table, u16), UsageError> {
    let (digits, radix) = match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(hex) => (hex, 16),
        None => (text, 10),
    };
    let number = u32::from_str_radix(digits, radix)
        .map_err(|_| usage(format!("'{text}' is no address: write 40001, 0 or 0x10")))?;
    let traditional = table.is_none() && radix == 10 && matches!(digits.len(), 5 | 6);
    let (table, at) = if traditional {
        let (first, rest) = digits.split_at(1);
        let table = Table::ALL.into_iter().find(|t| t.digit().to_string() == first);
        let table = table.ok_or_else(|| {
            usage(format!("'{text}': numbers begin with 0, 1, 3 or 4; with --table they count from 0"))
        })?;
        let entry = rest.parse::<u32>().unwrap_or(0);
        let at = entry.checked_sub(1).ok_or_else(|| usage(format!("'{text}': entries count from 1")))?;
        (table, at)
    } else {
        (table.unwrap_or(Table::HoldingRegisters), number)
    };
    let at = u16::try_from(at).map_err(|_| usage(format!("'{text}': addresses end at 65535 (465536)")))?;
    Ok((table, at))
}

fn parse(text: &str, form: &PointArgs, count: u16) -> Result<Point, UsageError> {
    let (name, rest) = match text.split_once('=') {
        Some((name, rest)) => (Some(name.trim().to_owned()), rest.trim()),
        None => (None, text.trim()),
    };
    let mut parts = rest.split(':');
    let place = parts.next().unwrap_or_default();
    // Not the x of 0x10.
    let (place, count) = match place.rfind('x').filter(|&at| at > 1 || !place.starts_with('0')) {
        Some(at) if at > 0 => {
            let n = place[at + 1..].parse::<u16>().ok().filter(|&n| n > 0);
            (&place[..at], n.ok_or_else(|| usage(format!("'{text}': a count stands behind x")))?)
        }
        _ => (place, count),
    };
    let (table, at) = address(place, form.table)?;
    let value_type = match parts.next() {
        Some(name) => Some(ValueType::parse(name).map_err(usage)?),
        None => form.value_type,
    };
    let value_type = match (table.is_bits(), value_type) {
        (true, None | Some(ValueType::Bit)) => ValueType::Bit,
        (true, Some(_)) => return Err(usage(format!("'{text}': {} are bits", table.name()))),
        (false, Some(ValueType::Bit)) => {
            return Err(usage(format!("'{text}': {} are no bits", table.name())));
        }
        (false, other) => other.unwrap_or(ValueType::Uint(1)),
    };
    let order = match parts.next() {
        Some(name) => parse_order(name).map_err(usage)?,
        None => form.order.unwrap_or_default(),
    };
    if let Some(more) = parts.next() {
        return Err(usage(format!("'{text}': what is ':{more}'?")));
    }
    if !order.is_for(value_type.registers()) {
        let values = match value_type.registers() {
            1 => "one register".to_owned(),
            more => format!("{more} registers"),
        };
        return Err(usage(format!("'{text}': order {} is not for values of {values}", order.name())));
    }
    let point = Point { name, table, at, count, value_type, order };
    let most = if table.is_bits() { 2000 } else { 125 };
    let entries = usize::from(count) * value_type.registers();
    if entries == 0 || entries > most {
        return Err(usage(format!(
            "'{text}': one request reads 1 to {most} {}, not {entries}",
            table.name()
        )));
    }
    ends_in_table(text, &point, entries)?;
    Ok(point)
}

/// The points of a read.
pub fn parse_all(texts: &[String], form: &PointArgs, count: u16) -> Result<Vec<Point>, UsageError> {
    texts.iter().map(|text| parse(text, form, count)).collect()
}

/// The points of a write with the registers or bits to write.
pub fn parse_writes(texts: &[String], form: &PointArgs) -> Result<Vec<(Point, Vec<Value>)>, UsageError> {
    texts.iter().map(|text| parse_write(text, form)).collect()
}

fn parse_write(text: &str, form: &PointArgs) -> Result<(Point, Vec<Value>), UsageError> {
    let (place, values) = text.split_once('=').ok_or_else(|| {
        usage(format!("'{text}' is no assignment: write ADDRESS=VALUE, for example 40001=5"))
    })?;
    let mut point = parse(place, form, 1)?;
    if !matches!(point.table, Table::Coils | Table::HoldingRegisters) {
        return Err(usage(format!("'{text}': {} cannot be written", point.table.name())));
    }
    let mut out = Vec::new();
    if point.value_type == ValueType::Text {
        let mut bytes = values.as_bytes().to_vec();
        bytes.resize(bytes.len().next_multiple_of(2), 0);
        if !(2..=2 * 123).contains(&bytes.len()) {
            return Err(usage(format!("'{text}': one request writes 1 to 246 characters")));
        }
        if point.order == Order::BA {
            bytes.chunks_exact_mut(2).for_each(|c| c.swap(0, 1));
        }
        out.extend(bytes.chunks(2).map(|c| json!(u16::from_be_bytes([c[0], c[1]]))));
        point.count = out.len() as u16;
        ends_in_table(text, &point, out.len())?;
        return Ok((point, out));
    }
    let given = values.split(',').count();
    let wanted = usize::from(point.count);
    if given > 1 && wanted == 1 && matches!(point.value_type, ValueType::Float(_)) {
        let name = place.trim();
        let (head, tail) = name.split_at(name.find(':').unwrap_or(name.len()));
        return Err(usage(format!(
            "'{text}': write {} with a decimal point; {given} values are written by {head}x{given}{tail}={values}",
            values.replacen(',', ".", 1)
        )));
    }
    if wanted > 1 && wanted != given {
        return Err(usage(format!("'{text}': {wanted} values are to be written, and {given} given")));
    }
    let mut count = 0;
    for value in values.split(',') {
        encode(value.trim(), &point, &mut out).ok_or_else(|| {
            usage(format!("'{text}': '{value}' is no value here: values are {}", point.value_type.words()))
        })?;
        count += 1;
    }
    point.count = count;
    let most = if point.table.is_bits() { 1968 } else { 123 };
    if out.len() > most {
        return Err(usage(format!("'{text}': one request writes up to {most} {}", point.table.name())));
    }
    ends_in_table(text, &point, out.len())?;
    Ok((point, out))
}

/// Whether so many entries from the point on have addresses.
fn ends_in_table(text: &str, point: &Point, entries: usize) -> Result<(), UsageError> {
    if usize::from(point.at) + entries > 65_536 {
        return Err(usage(format!("'{text}': reaches behind address 65535")));
    }
    Ok(())
}

/// A value as registers or bits.
fn encode(text: &str, point: &Point, out: &mut Vec<Value>) -> Option<()> {
    let integer = |text: &str| -> Option<i128> {
        match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
            Some(hex) => i128::from_str_radix(hex, 16).ok(),
            None => text.parse().ok(),
        }
    };
    let registers = point.value_type.registers();
    let mut bytes: [u8; 8] = match point.value_type {
        ValueType::Bit => {
            let on = match text.to_ascii_lowercase().as_str() {
                "1" | "on" | "true" => true,
                "0" | "off" | "false" => false,
                _ => return None,
            };
            out.push(json!(on));
            return Some(());
        }
        ValueType::Int(n) | ValueType::Uint(n) => {
            let (bits, value) = (n as u32 * 16, integer(text)?);
            let low = if matches!(point.value_type, ValueType::Int(_)) { -(1i128 << (bits - 1)) } else { 0 };
            let high = if low < 0 { (1i128 << (bits - 1)) - 1 } else { (1i128 << bits) - 1 };
            (low..=high).contains(&value).then_some((value as i64).to_le_bytes())?
        }
        ValueType::Float(2) => {
            let mut bytes = [0; 8];
            bytes[..4].copy_from_slice(&text.parse::<f32>().ok()?.to_le_bytes());
            bytes
        }
        ValueType::Float(_) => text.parse::<f64>().ok()?.to_le_bytes(),
        ValueType::Hex => {
            let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")).unwrap_or(text);
            u64::from(u16::from_str_radix(digits, 16).ok()?).to_le_bytes()
        }
        ValueType::Text => return None,
    };
    let wire = &mut bytes[..registers * 2];
    point.order.turn(registers, wire);
    out.extend(wire.chunks(2).map(|c| json!(u16::from_be_bytes([c[0], c[1]]))));
    Some(())
}

/// The values of a point from the registers or bits of an answer.
pub fn decode(point: &Point, entries: &[u16]) -> Vec<Value> {
    if point.value_type == ValueType::Bit {
        return entries.iter().map(|&bit| json!(bit == 1)).collect();
    }
    if point.value_type == ValueType::Text {
        let mut bytes: Vec<u8> = entries.iter().flat_map(|r| r.to_be_bytes()).collect();
        if point.order == Order::BA {
            bytes.chunks_exact_mut(2).for_each(|c| c.swap(0, 1));
        }
        let end = bytes.iter().rposition(|&b| b != 0 && b != b' ').map_or(0, |at| at + 1);
        let text: String =
            bytes[..end].iter().flat_map(|b| std::ascii::escape_default(*b)).map(char::from).collect();
        return vec![json!(text)];
    }
    let registers = point.value_type.registers();
    entries
        .chunks_exact(registers)
        .map(|chunk| {
            let mut wire = [0; 8];
            for (slot, register) in wire.chunks_exact_mut(2).zip(chunk) {
                slot.copy_from_slice(&register.to_be_bytes());
            }
            point.order.turn(registers, &mut wire[..registers * 2]);
            let bits = u64::from_le_bytes(wire);
            match point.value_type {
                ValueType::Int(n) => {
                    let unused = 64 - n as u32 * 16;
                    json!((bits << unused) as i64 >> unused)
                }
                ValueType::Float(2) => {
                    // The shortest text of the 32-bit number, not that of its 64-bit neighbour.
                    let value = f32::from_bits(bits as u32);
                    value.to_string().parse::<f64>().map_or(json!(value.to_string()), |v| json!(v))
                }
                ValueType::Float(_) => json!(f64::from_bits(bits)),
                ValueType::Hex => json!(format!("{bits:04X}")),
                _ => json!(bits),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn form() -> PointArgs {
        PointArgs { table: None, value_type: None, order: None }
    }

    #[test]
    fn points() {
        let shown = |text: &str| {
            let p = parse(text, &form(), 1).unwrap();
            format!(
                "{:?} {} {} x{} {:?} {}",
                p.name,
                p.table.name(),
                p.at,
                p.count,
                p.value_type,
                p.order.name()
            )
        };
        assert_eq!(shown("40001"), "None holding_registers 0 x1 Uint(1) ABCD");
        assert_eq!(shown("0"), "None holding_registers 0 x1 Uint(1) ABCD");
        assert_eq!(shown("0x10x3"), "None holding_registers 16 x3 Uint(1) ABCD");
        assert_eq!(shown("Power=30010:float:CDAB"), "Some(\"Power\") input_registers 9 x1 Float(2) CDAB");
        assert_eq!(shown("00017x8"), "None coils 16 x8 Bit ABCD");
        assert_eq!(shown("465536"), "None holding_registers 65535 x1 Uint(1) ABCD");
        let zero_based = PointArgs { table: Some(Table::InputRegisters), ..form() };
        assert_eq!(parse("40001", &zero_based, 2).unwrap().at, 40001);
        let wrong: Vec<String> = [
            "x",
            "20001",
            "40000",
            "99999999",
            "0:float:AB",
            "0:int16:DCBA",
            "00001:float",
            "0x1FFFF",
            "40001:int16:AB:z",
            "0x",
            "65535x2",
        ]
        .iter()
        .map(|text| parse(text, &form(), 1).unwrap_err().0)
        .collect();
        insta::assert_snapshot!(wrong.join("\n"), @r#"
        'x' is no address: write 40001, 0 or 0x10
        '20001': numbers begin with 0, 1, 3 or 4; with --table they count from 0
        '40000': entries count from 1
        '99999999': addresses end at 65535 (465536)
        '0:float:AB': order AB is not for values of 2 registers
        '0:int16:DCBA': order DCBA is not for values of one register
        '00001:float': coils are bits
        '0x1FFFF': addresses end at 65535 (465536)
        '40001:int16:AB:z': what is ':z'?
        '0x' is no address: write 40001, 0 or 0x10
        '65535': numbers begin with 0, 1, 3 or 4; with --table they count from 0
        "#);
    }

    #[test]
    fn the_order_of_values_is_shown() {
        let shown = ["40001", "40001:float", "40001:uint32:CDAB", "40001:int16:BA", "00001", "40001:double"]
            .map(|text| parse(text, &form(), 1).unwrap().form());
        assert_eq!(shown, ["uint16", "float ABCD", "uint32 CDAB", "int16 BA", "bit", "double ABCD"]);
    }

    #[test]
    fn values_there_and_back() {
        for (text, words, value) in [
            ("40001=5", vec![5], json!(5)),
            ("40001:int16=-1", vec![0xFFFF], json!(-1)),
            ("40001:float=1.5", vec![0x3FC0, 0], json!(1.5)),
            ("40001:float:CDAB=1.1", vec![0xCCCD, 0x3F8C], json!(1.1)),
            ("40001:uint32:DCBA=0x11223344", vec![0x4433, 0x2211], json!(0x1122_3344)),
            ("40001:int64=-2", vec![0xFFFF, 0xFFFF, 0xFFFF, 0xFFFE], json!(-2)),
            ("40001:double=0.1", vec![0x3FB9, 0x9999, 0x9999, 0x999A], json!(0.1)),
            ("40001:hex=BEEF", vec![0xBEEF], json!("BEEF")),
            ("40001:string=abc", vec![0x6162, 0x6300], json!("abc")),
        ] {
            let (point, written) = parse_write(text, &form()).unwrap();
            let registers: Vec<u16> = written.iter().map(|v| v.as_u64().unwrap() as u16).collect();
            assert_eq!(registers, words, "{text}");
            assert_eq!(decode(&point, &registers), [value], "{text}");
        }
        let (point, bits) = parse_write("00003=on,off,1", &form()).unwrap();
        assert_eq!((point.at, bits), (2, vec![json!(true), json!(false), json!(true)]));
        // A text with its characters exchanged, as it is read.
        let (point, written) = parse_write("40001:string:BA=abc", &form()).unwrap();
        assert_eq!(written, [json!(0x6261), json!(0x0063)]);
        assert_eq!(decode(&point, &[0x6261, 0x0063]), [json!("abc")]);
    }

    #[test]
    fn values_that_cannot_be_written() {
        let long = format!("40001:string={}", "x".repeat(247));
        let texts = [
            "40001",
            "30001=1",
            "40001=65536",
            "40001:int16=40000",
            "40001=",
            "00001=2",
            "40001:float=x",
            "40001:hex=12345",
            "40001:string=",
            &long,
            "465536=1,2",
            "465536:string=abc",
            "40001:float=1,5",
            "40001:double:CDAB=-1,5",
            "40001x3=1,2",
        ];
        let wrong: Vec<String> = texts.iter().map(|text| parse_write(text, &form()).unwrap_err().0).collect();
        insta::assert_snapshot!(wrong.join("\n").replace(&"x".repeat(247), "..."), @r#"
        '40001' is no assignment: write ADDRESS=VALUE, for example 40001=5
        '30001=1': input_registers cannot be written
        '40001=65536': '65536' is no value here: values are whole numbers from 0 to 65535
        '40001:int16=40000': '40000' is no value here: values are whole numbers from -32768 to 32767
        '40001=': '' is no value here: values are whole numbers from 0 to 65535
        '00001=2': '2' is no value here: values are on or off, true or false, 1 or 0
        '40001:float=x': 'x' is no value here: values are numbers like 1.5
        '40001:hex=12345': '12345' is no value here: values are up to four hexadecimal digits
        '40001:string=': one request writes 1 to 246 characters
        '40001:string=...': one request writes 1 to 246 characters
        '465536=1,2': reaches behind address 65535
        '465536:string=abc': reaches behind address 65535
        '40001:float=1,5': write 1.5 with a decimal point; 2 values are written by 40001x2:float=1,5
        '40001:double:CDAB=-1,5': write -1.5 with a decimal point; 2 values are written by 40001x2:double:CDAB=-1,5
        '40001x3=1,2': 3 values are to be written, and 2 given
        "#);
        let (point, written) = parse_write("40001x2:float=1,5", &form()).unwrap();
        assert_eq!((point.count, written.len()), (2, 4));
        let (point, written) = parse_write("40001=1,2,3", &form()).unwrap();
        assert_eq!((point.count, written.len()), (3, 3));
    }
}
