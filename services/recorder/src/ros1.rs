//! Decoding ROS 1's packed encoding by its schema text, for people: what `cat` prints of any message, also of a
//! recording that another version made.

use serde_json::{Map, Value, json};

/// Fields of one schema that are followed.
const MAX_FIELDS: usize = 256;
/// Elements of an array that are shown; byte arrays are shown whole.
const MAX_ELEMENTS: usize = 4096;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Type {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Count {
    One,
    Fixed(usize),
    /// A `uint32` before the elements says how many.
    Counted,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Field {
    name: String,
    kind: Type,
    count: Count,
}

/// A schema that can decode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout(Vec<Field>);

impl Layout {
    /// From `ros1msg` text. `None` for what dinrail's messages never have: nested types, strings, constants.
    pub fn parse(text: &str) -> Option<Self> {
        let mut fields = Vec::new();
        for line in text.lines() {
            let line = line.split('#').next().unwrap_or_default().trim();
            if line.is_empty() {
                continue;
            }
            let (kind, name) = line.split_once(' ')?;
            let name = name.trim();
            if fields.len() >= MAX_FIELDS || name.contains([' ', '=']) {
                return None;
            }
            let (base, count) = match kind.split_once('[') {
                None => (kind, Count::One),
                Some((base, "]")) => (base, Count::Counted),
                Some((base, n)) => (base, Count::Fixed(n.strip_suffix(']')?.parse().ok()?)),
            };
            let kind = match base {
                "uint8" | "bool" | "byte" | "char" => Type::U8,
                "int8" => Type::I8,
                "uint16" => Type::U16,
                "int16" => Type::I16,
                "uint32" => Type::U32,
                "int32" => Type::I32,
                "uint64" => Type::U64,
                "int64" => Type::I64,
                "float32" => Type::F32,
                "float64" => Type::F64,
                _ => return None,
            };
            fields.push(Field { name: name.to_owned(), kind, count });
        }
        Some(Self(fields))
    }

    /// The fields of a message; byte arrays as hex digits. `None` when the message is shorter than its schema.
    pub fn decode(&self, mut bytes: &[u8]) -> Option<Map<String, Value>> {
        let mut map = Map::new();
        for field in &self.0 {
            let value = match field.count {
                Count::One => one(field.kind, &mut bytes)?,
                Count::Fixed(n) => many(field.kind, n, &mut bytes)?,
                Count::Counted => {
                    let n = u32::from_le_bytes(take(&mut bytes)?) as usize;
                    many(field.kind, n, &mut bytes)?
                }
            };
            map.insert(field.name.clone(), value);
        }
        Some(map)
    }
}

fn take<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
    let (now, later) = bytes.split_first_chunk::<N>()?;
    *bytes = later;
    Some(*now)
}

fn one(kind: Type, bytes: &mut &[u8]) -> Option<Value> {
    Some(match kind {
        Type::U8 => json!(u8::from_le_bytes(take(bytes)?)),
        Type::I8 => json!(i8::from_le_bytes(take(bytes)?)),
        Type::U16 => json!(u16::from_le_bytes(take(bytes)?)),
        Type::I16 => json!(i16::from_le_bytes(take(bytes)?)),
        Type::U32 => json!(u32::from_le_bytes(take(bytes)?)),
        Type::I32 => json!(i32::from_le_bytes(take(bytes)?)),
        Type::U64 => json!(u64::from_le_bytes(take(bytes)?)),
        Type::I64 => json!(i64::from_le_bytes(take(bytes)?)),
        Type::F32 => json!(f32::from_le_bytes(take(bytes)?)),
        Type::F64 => json!(f64::from_le_bytes(take(bytes)?)),
    })
}

fn many(kind: Type, n: usize, bytes: &mut &[u8]) -> Option<Value> {
    if kind == Type::U8 {
        let (now, later) = bytes.split_at_checked(n)?;
        *bytes = later;
        return Some(Value::String(hex(now)));
    }
    if n > MAX_ELEMENTS {
        return None;
    }
    (0..n).map(|_| one(kind, bytes)).collect::<Option<Vec<_>>>().map(Value::Array)
}

/// Bytes as hex digits.
pub fn hex(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 16] = b"0123456789ABCDEF";
    bytes.iter().flat_map(|b| [b >> 4, b & 15]).map(|d| char::from(DIGITS[usize::from(d)])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::payload::{Inputs, as_bytes};
    use ipc_types::topic::TopicKind;
    use proptest::prelude::*;

    #[test]
    fn our_own_schemas_decode() {
        for kind in TopicKind::ALL {
            let layout = Layout::parse(&kind.ros1msg()).unwrap();
            let map = layout.decode(&vec![0u8; kind.header_bytes()]).unwrap();
            assert_eq!(map["seq"], 0, "{kind:?}");
            assert!(layout.decode(&vec![0u8; kind.header_bytes() - 1]).is_none(), "{kind:?}");
        }
        let inputs = Inputs { data_t_ns: 7, ranges: 2, n: 3, ..Inputs::default() };
        let mut bytes = as_bytes(&inputs).to_vec();
        bytes.extend_from_slice(&[0xAB, 0, 1]);
        let map = Layout::parse(&TopicKind::Inputs.ros1msg()).unwrap().decode(&bytes).unwrap();
        assert_eq!(
            (&map["data_t_ns"], &map["ranges"], &map["data"]),
            (&json!(7), &json!(2), &json!("AB0001"))
        );
    }

    #[test]
    fn schemas_with_more_than_numbers_are_left_alone() {
        for text in ["std_msgs/Header header\n", "string name\n", "uint8 A=1\n", "uint8\n", "uint8[x] a\n"] {
            assert_eq!(Layout::parse(text), None, "{text}");
        }
        assert!(Layout::parse("# comment\n\nuint8 a # of a\n").is_some());
    }

    proptest! {
        #[test]
        fn any_schema_and_message_is_survived(text in "[uintfloa0-9\\[\\] \n#=]{0,80}", bytes: Vec<u8>) {
            if let Some(layout) = Layout::parse(&text) {
                let _ = layout.decode(&bytes);
            }
            let _ = Layout::parse("uint64[] a\nuint8[] b\nfloat32[3] c\n").unwrap().decode(&bytes);
        }
    }
}
