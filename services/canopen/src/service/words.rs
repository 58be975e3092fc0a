//! What the network did, in sentences for people.

use crate::master::boot::{Failure, Loaded};
use crate::master::network::{Event, Sign, state_name};
use crate::protocol::abort::Abort;
use ipc_types::event::{EventKind, Level};
use serde_json::{Value, json};

/// A sentence about a boot-up that failed; `object` names objects.
pub fn failure_text(failure: &Failure, object: impl Fn(u16, u8) -> String) -> String {
    let mut text = format!("boot-up failed with letter {}: {}", failure.letter, failure.letter.text());
    if let (Some(expected), Some(got)) = (failure.expected, failure.got) {
        text.push_str(&format!(" (expected {expected:#010X}, it has {got:#010X})"));
    }
    if let Some((index, sub)) = failure.object {
        text.push_str(&format!(" (at {})", object(index, sub)));
    }
    if let Some(abort) = failure.abort {
        text.push_str(&format!(" (the node answered {})", Abort(abort)));
    } else if failure.object.is_some() {
        text.push_str(" (the node did not answer in time: did it die?)");
    }
    text.push_str(&format!("; try {}, after {} ms", failure.attempt, failure.after_ns / 1_000_000));
    text
}

/// Why a configuration was loaded, behind "is booted".
fn loaded_text(Loaded { had, expected: (date, time) }: Loaded) -> String {
    let had = match had {
        Some((0, 0)) => {
            "it was never configured, or was changed since (date and time are 0 in 1020h)".to_owned()
        }
        Some((date, time)) => format!("it had date {date} and time {time} (1020h)"),
        None => "it does not tell which one it has (1020h)".to_owned(),
    };
    format!("; its configuration was loaded: {had}, {date} and {time} are expected")
}

/// Kind, level, sentence and details of an event. `name` gives `node 5 (Test I/O)`.
pub fn event(
    event: &Event,
    name: impl Fn(u8) -> String,
    object: impl Fn(u16, u8) -> String,
) -> (EventKind, Level, String, Value) {
    let node_state = EventKind::NodeState;
    match *event {
        Event::Booted { node, attempts, kept, loaded } => {
            let how = if kept { "was running already and is left running" } else { "is booted" };
            let tries = if attempts > 1 { format!(" at try {attempts}") } else { String::new() };
            let mut detail =
                json!({ "node": node, "attempts": attempts, "kept": kept, "letter": kept.then_some("L") });
            if let Some(loaded) = loaded {
                detail["loaded"] = json!(loaded);
            }
            let why = loaded.map(loaded_text).unwrap_or_default();
            (node_state, Level::Info, format!("{} {how}{tries}{why}", name(node)), detail)
        }
        Event::BootFailed { node, failure } => {
            let text = format!("{}: {}", name(node), failure_text(&failure, object));
            (node_state, Level::Fault, text, json!({ "node": node, "failure": failure }))
        }
        Event::Lost { node, guarding } => {
            let what = if guarding {
                "does not answer node guarding any more"
            } else {
                "sends no heartbeat any more"
            };
            let text = format!("{} is lost: it {what}; it is booted again when it returns", name(node));
            (node_state, Level::Fault, text, json!({ "node": node }))
        }
        Event::State { node, state, wanted } => {
            let text = format!(
                "{} is {} instead of {}: somebody else commanded it, or it has an error; it is started again",
                name(node),
                state_name(state),
                state_name(wanted)
            );
            (node_state, Level::Warning, text, json!({ "node": node, "state": state }))
        }
        Event::Rebooted { node } => {
            let text = format!("{} booted by itself: it was reset or lost its power", name(node));
            (node_state, Level::Warning, text, json!({ "node": node }))
        }
        Event::Emcy { node, code, register, vendor } => {
            let bytes: String = vendor.iter().map(|b| format!("{b:02X}")).collect();
            let detail = json!({ "node": node, "code": code, "register": register, "vendor": bytes });
            if code == 0 {
                let text = format!("{} reports that its error is gone", name(node));
                return (EventKind::Emcy, Level::Info, text, detail);
            }
            let text = format!(
                "{} reports emergency {code:04X}h, {}; error register {register:02X}h, vendor bytes {bytes}",
                name(node),
                emcy_class(code)
            );
            (EventKind::Emcy, Level::Warning, text, detail)
        }
        Event::Unknown { node } => {
            let text = format!(
                "a device with node-id {node} booted, but the stack file has no such node (letter A); `dinrail canopen scan --toml` prints it"
            );
            (node_state, Level::Warning, text, json!({ "node": node, "letter": "A" }))
        }
        Event::Duplicate { node, sign } => {
            let sign = match sign {
                Sign::States => "its state changes to and fro without command",
                Sign::Heartbeats => "twice as many heartbeats come as one device was told to send",
                Sign::Emcy => "one of them hears the other (emergency 8150h)",
            };
            let text = format!("two devices seem to have node-id {node}: {sign}; give one of them another");
            (node_state, Level::Fault, text, json!({ "node": node }))
        }
        Event::MandatoryMissing { node, missing } => {
            let more = if missing > 1 { format!(" and {} more", missing - 1) } else { String::new() };
            let text = format!(
                "{}{more} is mandatory and not booted in time; the network is incomplete",
                name(node)
            );
            (node_state, Level::Fault, text, json!({ "node": node, "missing": missing }))
        }
        Event::NetworkStarted => {
            let text = "all mandatory nodes are booted: the network runs".to_owned();
            (node_state, Level::Info, text, Value::Null)
        }
        Event::BusOff => {
            let text = "the bus is off: SYNC stops, the network is booted when the bus is back".to_owned();
            (EventKind::BusState, Level::Fault, text, Value::Null)
        }
        Event::BusBack => (
            EventKind::BusState,
            Level::Info,
            "the bus is back: the network is booted".to_owned(),
            Value::Null,
        ),
    }
}

/// Error class of an emergency code (CiA 301 V4.2, table 26).
fn emcy_class(code: u16) -> &'static str {
    match code {
        0x8110 => "CAN overrun",
        0x8120 => "CAN in error passive mode",
        0x8130 => "life guard or heartbeat error",
        0x8140 => "recovered from bus-off",
        0x8150 => "CAN-ID collision",
        0x8210 => "PDO not processed because of its length",
        0x8220 => "PDO length exceeded",
        0x8240 => "unexpected SYNC data length",
        0x8250 => "RPDO timeout",
        _ => match code >> 8 {
            0x10 => "generic error",
            0x20..=0x2F => "current",
            0x30..=0x3F => "voltage",
            0x40..=0x4F => "temperature",
            0x50 => "device hardware",
            0x60..=0x6F => "device software",
            0x70 => "additional modules",
            0x81 => "communication",
            0x82 => "protocol error",
            0x80 => "monitoring",
            0x90 => "external error",
            0xF0 => "additional functions",
            0xFF => "device specific",
            _ => "unknown class",
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::master::boot::Letter;

    #[test]
    fn every_event_is_a_sentence() {
        let failure = Failure {
            letter: Letter::M,
            attempt: 2,
            expected: Some(0x22),
            got: Some(0x23),
            object: None,
            abort: None,
            after_ns: 12_000_000,
        };
        let refused = Failure {
            letter: Letter::J,
            expected: None,
            got: None,
            object: Some((0x1800, 2)),
            abort: Some(0x0609_0030),
            ..failure
        };
        let loaded = |attempts, had| {
            let loaded = Some(Loaded { had, expected: (100, 200) });
            Event::Booted { node: 5, attempts, kept: false, loaded }
        };
        let all = [
            Event::Booted { node: 5, attempts: 1, kept: false, loaded: None },
            Event::Booted { node: 5, attempts: 3, kept: true, loaded: None },
            loaded(2, Some((99, 200))),
            loaded(1, Some((0, 0))),
            loaded(1, None),
            Event::BootFailed { node: 5, failure },
            Event::BootFailed { node: 5, failure: refused },
            Event::BootFailed { node: 5, failure: Failure { abort: None, ..refused } },
            Event::BootFailed {
                node: 5,
                failure: Failure { letter: Letter::B, expected: None, got: None, ..failure },
            },
            Event::Lost { node: 5, guarding: false },
            Event::Lost { node: 5, guarding: true },
            Event::State { node: 5, state: 127, wanted: 5 },
            Event::Rebooted { node: 5 },
            Event::Emcy { node: 5, code: 0x8210, register: 0x11, vendor: [1, 2, 3, 4, 5] },
            Event::Emcy { node: 5, code: 0, register: 0, vendor: [0; 5] },
            Event::Unknown { node: 9 },
            Event::Duplicate { node: 5, sign: Sign::States },
            Event::Duplicate { node: 5, sign: Sign::Heartbeats },
            Event::Duplicate { node: 5, sign: Sign::Emcy },
            Event::MandatoryMissing { node: 5, missing: 2 },
            Event::NetworkStarted,
            Event::BusOff,
            Event::BusBack,
        ];
        let said: String = all
            .iter()
            .map(|e| {
                let (_, level, text, _) = event(
                    e,
                    |n| format!("node {n} (Test I/O)"),
                    |i, s| format!("{i:04X}:{s:02X} Transmission type"),
                );
                format!("{level:?}: {text}\n")
            })
            .collect();
        insta::assert_snapshot!(said);
    }
}
