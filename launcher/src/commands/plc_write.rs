//! `dinrail plc write` and `plc force`: every assignment is resolved and checked before the first is carried out, and
//! all are applied in one scan.
//!
//! They go to the engine as one job. Where it cannot take them, because it knows no symbols of the stack file without a
//! program or because they are too many, places in %Q and %M go as one message of image writes.

use super::plc::Names;
use super::{UsageError, println};
use crate::supervise::jobs::{JobError, JobLine};
use dinrail_iec::artifact::{AreaKind, ElemType, Storage};
use dinrail_iec::{AddressSize, Addressing, parse_address};
use dinrail_modbus::service::addressing_of;
use dinrail_plc::engine::value::Cell;
use dinrail_plc::engine::write_result;
use dinrail_plc::service::MAX_SET;
use ipc_types::Context;
use ipc_types::image_write::{Builder, MAX_BYTES, MAX_OPS, Op, WriteError};
use ipc_types::payload::{Image, ImageWrite, acks};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::scan_record::Patch;
use ipc_types::stack::Stack;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::Area;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// How long a job or a message may take.
const LIMIT: Duration = Duration::from_secs(5);
/// How often the image is looked at for the acknowledgement.
const LOOK: Duration = Duration::from_millis(2);

/// A variable and what it shall be.
pub type Assignment = (String, Value);

const ELEMENTS: [ElemType; 16] = [
    ElemType::Bool,
    ElemType::Byte,
    ElemType::Word,
    ElemType::Dword,
    ElemType::Lword,
    ElemType::Sint,
    ElemType::Int,
    ElemType::Dint,
    ElemType::Lint,
    ElemType::Usint,
    ElemType::Uint,
    ElemType::Udint,
    ElemType::Ulint,
    ElemType::Real,
    ElemType::Lreal,
    ElemType::Time,
];

/// What is done with the assignments.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Write,
    Force,
}

impl Kind {
    fn word(self) -> &'static str {
        match self {
            Self::Write => "written",
            Self::Force => "forced",
        }
    }
}

/// Carries out all assignments in one scan, or none. What would not last is remarked on stderr.
pub fn set(
    ctx: &mut Context,
    line: &mut JobLine,
    plc: &str,
    names: &Names,
    list: &[Assignment],
    (kind, as_json): (Kind, bool),
) -> anyhow::Result<()> {
    let (list, known) = check_all(&ctx.stack, line, plc, names, list, kind)?;
    match kind {
        Kind::Write => write(ctx, line, plc, &list, known)?,
        Kind::Force => {
            let job = set_job("force", &list).ok_or_else(|| too_many("forced", list.len()))?;
            ask(line, &job, &list, "forced")?;
        }
    }
    tell(names, kind, &list, as_json);
    if kind == Kind::Write {
        for (var, _) in &list {
            if let Some(owner) = names.input_owner(&ctx.stack, plc, var) {
                eprintln!("dinrail: {}", fleeting(var, owner));
            }
        }
        for var in held(line, &list) {
            eprintln!(
                "dinrail: '{var}' is forced and keeps its value; `dinrail plc unforce {var}` lets go of it"
            );
        }
    }
    Ok(())
}

/// Which of these are forced: what is written to them takes no effect.
fn held(line: &mut JobLine, list: &[Assignment]) -> Vec<String> {
    let Ok(answer) = line.ask(&json!({ "do": "status" }), LIMIT) else { return Vec::new() };
    let forces = answer.get("forces").and_then(Value::as_array).cloned().unwrap_or_default();
    let forced = |var: &str| forces.iter().any(|f| f.as_str().is_some_and(|f| f.eq_ignore_ascii_case(var)));
    list.iter().map(|(var, _)| var.clone()).filter(|var| forced(var)).collect()
}

fn fleeting(var: &str, owner: &str) -> String {
    format!(
        "'{var}' is an input that service '{owner}' delivers: its next value takes the place of what was written; `dinrail plc force` holds it"
    )
}

/// Asks the engine for every variable and compares its type with the value: nothing is carried out when one is wrong.
///
/// Hands over the assignments as the engine takes them, and whether it knows all of them: one of another version knows no
/// symbols of the stack file without a program, but their places are known here.
fn check_all(
    stack: &Stack,
    line: &mut JobLine,
    plc: &str,
    names: &Names,
    list: &[Assignment],
    kind: Kind,
) -> anyhow::Result<(Vec<Assignment>, bool)> {
    let (mut good, mut wrong, mut known) = (Vec::new(), Vec::new(), true);
    for (var, value) in list {
        let found = names.settable(var).and_then(|variable| Ok((variable.value(value)?, variable)));
        let (value, variable) = match found {
            Ok(found) => found,
            Err(text) => {
                wrong.push(text);
                continue;
            }
        };
        let var = &variable.path;
        match line.ask(&json!({ "do": "read", "var": var }), LIMIT) {
            Ok(answer) => wrong.extend(misfit(var, &value, &answer)),
            Err(JobError::Refused { text, .. }) => match place(stack, plc, var) {
                Some((_, cell)) if !var.starts_with('%') => {
                    known = false;
                    wrong.extend(cell.patch(var, &value).err().map(|e| e.to_string()));
                }
                _ => wrong.push(text),
            },
            Err(other) => return Err(other.into()),
        }
        good.push((var.clone(), value));
    }
    if wrong.is_empty() {
        return Ok((good, known));
    }
    let none = if list.len() > 1 { format!("nothing was {}: ", kind.word()) } else { String::new() };
    anyhow::bail!("{none}{}", wrong.join("; "))
}

/// Why a value cannot be this variable's, by what `read` says of it. A type that is not known here is left to the engine.
fn misfit(var: &str, value: &Value, answer: &Value) -> Option<String> {
    let type_name = answer.get("type").and_then(Value::as_str)?;
    if type_name.starts_with("ARRAY") {
        return Some(format!("'{var}' is an array: write its elements, like {var}[1]"));
    }
    let word = type_name.split_whitespace().next()?;
    let elem = ELEMENTS.into_iter().find(|elem| elem.name() == word)?;
    let cell = Cell { offset: 0, elem, storage: Storage::Plain };
    cell.patch(var, value).err().map(|e| e.to_string())
}

/// How assignments reach the engine whole.
enum Way {
    Job(Value),
    Message(Box<Builder>),
}

fn write(
    ctx: &mut Context,
    line: &mut JobLine,
    plc: &str,
    list: &[Assignment],
    known: bool,
) -> anyhow::Result<()> {
    match way(&ctx.stack, plc, list, known)? {
        Way::Job(job) => ask(line, &job, list, "written"),
        Way::Message(builder) => send(ctx, plc, &builder),
    }
}

fn ask(line: &mut JobLine, job: &Value, list: &[Assignment], what: &str) -> anyhow::Result<()> {
    match line.ask(job, LIMIT) {
        Ok(_) => Ok(()),
        Err(refused @ JobError::Refused { .. }) if list.len() > 1 => {
            anyhow::bail!("nothing was {what}: {refused}")
        }
        Err(e) => Err(e.into()),
    }
}

fn tell(names: &Names, kind: Kind, list: &[Assignment], as_json: bool) {
    if as_json {
        let done: Vec<Value> =
            list.iter().map(|(var, value)| json!({ "var": var, "value": value })).collect();
        println(&json!({ kind.word(): done, "one_scan": true }).to_string());
        return;
    }
    for (var, value) in list {
        let text = names.settable(var).map_or_else(|_| super::plc::plain(value), |v| v.text(value));
        println(&format!("{var} = {text}"));
    }
}

fn way(stack: &Stack, plc: &str, list: &[Assignment], known: bool) -> anyhow::Result<Way> {
    let job = set_job("write", list);
    match job {
        Some(job) if known => Ok(Way::Job(job)),
        job => match (message(stack, plc, list)?, job) {
            (Some(builder), _) => Ok(Way::Message(Box::new(builder))),
            (None, Some(job)) => Ok(Way::Job(job)),
            (None, None) => Err(too_many("written", list.len()).into()),
        },
    }
}

/// All assignments as one job, unless they are more than one takes.
fn set_job(what: &str, list: &[Assignment]) -> Option<Value> {
    let set: Vec<Value> = list.iter().map(|(var, value)| json!({ "var": var, "value": value })).collect();
    let job = json!({ "do": what, "set": set });
    let fits = job.to_string().len() <= TopicKind::Jobs.row().max_tail as usize;
    (list.len() <= MAX_SET && fits).then_some(job)
}

fn too_many(what: &str, count: usize) -> UsageError {
    let places = if what == "written" {
        format!(
            "; of places in %Q and %M also {MAX_OPS}, those in a row counting as one, in {MAX_BYTES} bytes with 12 for each"
        )
    } else {
        String::new()
    };
    UsageError(format!(
        "nothing was {what}: {count} assignments are more than one scan applies whole (at most {MAX_SET}, in 4096 bytes of JSON{places}); use several commands"
    ))
}

/// Bits of the image that are set: where, which, to what.
struct Change {
    area: Area,
    offset: u32,
    mask: Vec<u8>,
    value: Vec<u8>,
}

impl Change {
    fn is_whole(&self) -> bool {
        self.mask.iter().all(|mask| *mask == 0xFF)
    }

    fn push(&self, builder: &mut Builder) -> Result<(), WriteError> {
        let (area, offset) = (self.area, self.offset);
        if self.is_whole() {
            return builder.push(&Op::Set { area, offset, bytes: &self.value });
        }
        let and: Vec<u8> = self.mask.iter().map(|mask| !mask).collect();
        let or: Vec<u8> = self.mask.iter().zip(&self.value).map(|(mask, value)| mask & value).collect();
        builder.push(&Op::Mask { area, offset, and: &and, or: &or })
    }
}

/// All assignments as one message; `None`: something lies outside %Q and %M. Places in a row become one operation.
fn message(stack: &Stack, plc: &str, list: &[Assignment]) -> anyhow::Result<Option<Builder>> {
    let mut changes: Vec<Change> = Vec::new();
    for (var, value) in list {
        let Some((area, cell)) = place(stack, plc, var) else { return Ok(None) };
        let Patch { offset, len, mask, value } = cell.patch(var, value)?;
        let len = usize::from(len).min(8);
        let next = Change { area, offset, mask: mask[..len].to_vec(), value: value[..len].to_vec() };
        match changes.last_mut() {
            Some(last)
                if last.is_whole()
                    && next.is_whole()
                    && last.area == area
                    && last.offset + last.value.len() as u32 == offset =>
            {
                last.mask.extend(next.mask);
                last.value.extend(next.value);
            }
            _ => changes.push(next),
        }
    }
    let mut builder = Builder::default();
    for change in &changes {
        change.push(&mut builder).map_err(|_| too_many("written", list.len()))?;
    }
    Ok(Some(builder))
}

/// Where in %Q or %M a %-address lies, or a symbol that the stack file gives to a place there.
fn place(stack: &Stack, plc: &str, var: &str) -> Option<(Area, Cell)> {
    let var = var.trim();
    if var.starts_with('%') {
        return address(var, addressing_of(stack.service(plc)));
    }
    let of_plc = |wired: &Option<String>| wired.as_deref().is_none_or(|wired| wired == plc);
    let services = stack.services.iter().filter(|s| of_plc(&s.wiring.plc));
    let range = services
        .flat_map(|s| &s.wiring.outputs)
        .find(|r| r.symbol.as_deref().is_some_and(|symbol| symbol.eq_ignore_ascii_case(var)))?;
    if range.area == Area::Input {
        return None;
    }
    let elem = ELEMENTS.into_iter().find(|elem| range.type_name.as_deref() == Some(elem.name()))?;
    // A TIME at %QD has another form than one elsewhere: that is left to the engine.
    if elem == ElemType::Time || elem.bytes() != range.bytes {
        return None;
    }
    let storage = range.bit.map_or(Storage::Plain, Storage::Bit);
    Some((range.area, Cell { offset: range.byte, elem, storage }))
}

fn address(text: &str, addressing: Addressing) -> Option<(Area, Cell)> {
    let at = parse_address(text, addressing).ok()?;
    let area = match at.area {
        AreaKind::Output => Area::Output,
        AreaKind::Marker => Area::Marker,
        AreaKind::Input | AreaKind::Retain | AreaKind::Data => return None,
    };
    // The types that the engine gives to places without a variable.
    let elem = match at.size {
        AddressSize::Bit => ElemType::Bool,
        AddressSize::Byte => ElemType::Usint,
        AddressSize::Word => ElemType::Uint,
        AddressSize::Dword => ElemType::Udint,
        AddressSize::Lword => ElemType::Ulint,
    };
    let storage = at.bit.map_or(Storage::Plain, Storage::Bit);
    Some((area, Cell { offset: at.byte, elem, storage }))
}

/// Sends the message and waits until the engine has acknowledged it.
fn send(ctx: &mut Context, plc: &str, builder: &Builder) -> anyhow::Result<()> {
    let mut image: Subscriber<Image> = ctx.subscriber(&TopicKind::Image.of(plc))?;
    let mut writes: Publisher<ImageWrite> = ctx.publisher(&TopicKind::Writes.of(plc))?;
    let header = ImageWrite { ops: builder.ops(), ..ImageWrite::default() };
    let seq = writes.send_tail(header, builder.tail())?;
    writes.ring();
    let (writer, generation, begin) = (ctx.writer, ctx.generation, Instant::now());
    let mut result = None;
    while begin.elapsed() < LIMIT {
        image.newest(|header, _| {
            let ours = |a: &ipc_types::payload::AckEntry| {
                (a.writer, a.generation) == (writer, generation) && a.seq >= seq
            };
            result = acks(header).find(ours).map(|a| a.result);
        });
        if let Some(result) = result {
            return verdict(plc, result);
        }
        std::thread::sleep(LOOK);
    }
    anyhow::bail!(
        "plc '{plc}' has not acknowledged the write within {} s; see `dinrail ps`. It may still be applied within a second",
        LIMIT.as_secs()
    )
}

fn verdict(plc: &str, result: u32) -> anyhow::Result<()> {
    let why = match result {
        write_result::APPLIED => return Ok(()),
        write_result::TOO_OLD => "it waited for longer than a second; write it again",
        write_result::OLD_GENERATION => "it is of an older generation; write it again",
        write_result::MALFORMED => "the message is malformed; is the engine of another version?",
        write_result::OUTSIDE => {
            "a place lies outside of %Q or %M; see input_bytes, output_bytes and marker_bytes"
        }
        _ => "for a reason that this version does not know",
    };
    anyhow::bail!("plc '{plc}' has not applied the write: {why}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::image_write::parse;
    use ipc_types::stack::ServiceEntry;
    use ipc_types::wiring::{ImageRange, OnBad, Wiring};

    /// A stack whose service `io` sends %QB1 as `Lamps` and %QX2.3 as `Pump`.
    fn stack() -> Stack {
        let range = |byte, bit, type_name: &str, symbol: &str| ImageRange {
            area: Area::Output,
            byte,
            bit,
            bytes: 1,
            type_name: Some(type_name.to_owned()),
            symbol: Some(symbol.to_owned()),
            label: String::new(),
            key: String::new(),
            on_bad: OnBad::default(),
            status_byte: None,
        };
        let wiring = Wiring {
            plc: Some("plc".to_owned()),
            outputs: vec![range(1, None, "USINT", "Lamps"), range(2, Some(3), "BOOL", "Pump")],
            ..Wiring::default()
        };
        let (name, kind) = ("io".to_owned(), "can-io".to_owned());
        Stack {
            name: "s".to_owned(),
            file: "s.toml".into(),
            dir: ".".into(),
            text: String::new(),
            build_id: String::new(),
            root: "/".into(),
            prefix: String::new(),
            services: vec![ServiceEntry { name, kind, index: 1, config: Value::Null, wiring }],
            topics: Vec::new(),
        }
    }

    fn built(list: &[(&str, Value)]) -> anyhow::Result<Option<String>> {
        let list: Vec<Assignment> =
            list.iter().map(|(var, value)| ((*var).to_owned(), value.clone())).collect();
        let Some(builder) = message(&stack(), "plc", &list)? else { return Ok(None) };
        Ok(Some(parse(builder.tail()).unwrap().map(|op| format!("{op:?}")).collect::<Vec<_>>().join("\n")))
    }

    #[test]
    fn places_of_the_image_go_in_one_message() {
        let list = [
            ("%MW1", json!(0x1234)),
            ("%QX0.3", json!(true)),
            ("%mx2.0", json!(false)),
            ("%MD4", json!("16#FF")),
        ];
        insta::assert_snapshot!(built(&list).unwrap().unwrap(), @r#"
Set { area: Marker, offset: 2, bytes: [52, 18] }
Mask { area: Output, offset: 0, and: [247], or: [8] }
Mask { area: Marker, offset: 2, and: [254], or: [0] }
Set { area: Marker, offset: 16, bytes: [255, 0, 0, 0] }
"#);
        insta::assert_snapshot!(built(&[("lamps", json!(7)), ("Pump", json!(true))]).unwrap().unwrap(), @r#"
Set { area: Output, offset: 1, bytes: [7] }
Mask { area: Output, offset: 2, and: [247], or: [8] }
"#);
        assert!(place(&stack(), "other", "Lamps").is_none());
        // Inputs and variables of the program lie elsewhere.
        assert_eq!(built(&[("%MW0", json!(1)), ("Main.Speed", json!(1))]).unwrap(), None);
        assert_eq!(built(&[("%MW0", json!(1)), ("%IW0", json!(1))]).unwrap(), None);
    }

    #[test]
    fn what_does_not_fit_one_message_is_not_written() {
        let vars: Vec<String> = (0..=MAX_OPS).map(|i| format!("%MW{}", 2 * i)).collect();
        let list: Vec<(&str, Value)> = vars.iter().map(|var| (var.as_str(), json!(1))).collect();
        assert!(built(&list[..MAX_OPS]).unwrap().is_some());
        let error = built(&list).unwrap_err();
        assert!(
            error.is::<UsageError>()
                && error.to_string().starts_with("nothing was written: 17 assignments are more"),
            "{error}"
        );
        // In a row they are one operation, up to the bytes of a message.
        let row =
            |count: usize| (0..count).map(|i| (format!("%MW{i}"), json!(i))).collect::<Vec<Assignment>>();
        let ops = |count| message(&stack(), "plc", &row(count)).map(|builder| builder.unwrap().ops());
        assert_eq!(ops(17).unwrap(), 1);
        assert_eq!(ops(250).unwrap(), 1);
        assert!(ops(251).is_err());
    }

    #[test]
    fn variables_go_as_one_job_and_places_too_where_the_engine_knows_them() {
        let of = |list: &[Assignment], known| {
            way(&stack(), "plc", list, known).map(|way| match way {
                Way::Job(job) => job["set"].as_array().unwrap().len(),
                Way::Message(builder) => 1000 + builder.ops() as usize,
            })
        };
        let list = |count: usize, name: &str| -> Vec<Assignment> {
            (0..count).map(|i| (format!("{name}{}", 2 * i), json!(1))).collect()
        };
        assert_eq!(of(&list(3, "Main.v"), true).unwrap(), 3);
        assert_eq!(of(&list(17, "%MW"), true).unwrap(), 17);
        assert_eq!(of(&list(3, "%MW"), false).unwrap(), 1003, "with a symbol that the engine does not know");
        let row: Vec<Assignment> = (0..250).map(|i| (format!("%MW{i}"), json!(i))).collect();
        assert_eq!(of(&row, true).unwrap(), 1001, "too many for a job");
        assert_eq!(of(&list(MAX_SET, "Main.v"), true).unwrap(), MAX_SET);
        for list in [list(MAX_SET + 1, "Main.v"), list(60, &"long".repeat(20)), list(MAX_SET + 1, "%MW")] {
            let error = of(&list, true).unwrap_err();
            assert!(
                error.is::<UsageError>() && error.to_string().contains("(at most 64, in 4096"),
                "{error}"
            );
            assert!(set_job("force", &list).is_none());
        }
    }

    #[test]
    fn values_are_compared_with_the_types_before_anything_is_written() {
        let of = |type_name: &str| json!({ "value": 0, "type": type_name });
        for (value, type_name) in [
            (json!(1), "INT"),
            (json!(true), "BOOL"),
            (json!("16#FFFF"), "WORD"),
            (json!("T#5s"), "TIME (ms)"),
            (json!(1.5), "REAL"),
            (json!("anything"), "A_TYPE_OF_LATER"),
        ] {
            assert_eq!(misfit("x", &value, &of(type_name)), None, "{type_name}");
        }
        let said: Vec<String> = [
            (json!("bad"), "INT"),
            (json!(70000), "UINT"),
            (json!(2), "BOOL"),
            (json!("soon"), "TIME (ms)"),
            (json!(1), "ARRAY OF INT"),
        ]
        .iter()
        .filter_map(|(value, type_name)| misfit("x", value, &of(type_name)))
        .collect();
        insta::assert_snapshot!(said.join("\n"), @r#"
'x' is INT; "bad" does not fit: give a whole number in its range
'x' is UINT; 70000 does not fit: give a whole number in its range
'x' is BOOL; 2 does not fit: give true or false
'x' is TIME; "soon" does not fit: give milliseconds or a text like "1.5s"
'x' is an array: write its elements, like x[1]
"#);
    }

    #[test]
    fn a_write_that_will_not_last_is_remarked() {
        assert!(
            fleeting("Level", "io").contains("service 'io' delivers")
                && fleeting("x", "y").contains("plc force")
        );
    }

    #[test]
    fn refusals_of_the_engine_are_told() {
        assert!(verdict("plc", write_result::APPLIED).is_ok());
        for result in [1, 2, 3, 4, 99] {
            let said = verdict("plc", result).unwrap_err().to_string();
            assert!(said.starts_with("plc 'plc' has not applied the write: "), "{said}");
        }
    }
}
