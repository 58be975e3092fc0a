//! From the stack file to tables: every address, identifier and signal resolved, every mistake named.

use dinrail_iec::artifact::AreaKind;
use dinrail_iec::{AddressSize, Addressing, LocatedAddress, parse_address};

use crate::config::{
    Config, Id, Input, MAX_INPUTS, MAX_OUTPUTS, MAX_SIGNALS, Mode, OnBadValue, OnBadWord, OnStop, OnStopWord,
    Output, OutputSignal,
};
use crate::protocol::signal::{ByteOrder, Signal};
use crate::protocol::value::{Codec, IecType, Raw};

/// `can_id` bit of a 29-bit identifier.
pub const EFF_FLAG: u32 = 0x8000_0000;

/// Something wrong in the service's table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mistake {
    /// Path of the key: `in[2].to`.
    pub key: String,
    /// What is wrong.
    pub message: String,
    /// What to do about it.
    pub help: String,
}

/// An input ready to run.
#[derive(Debug, Clone)]
pub struct InputPoint {
    /// Index of its `[[service.in]]`.
    pub index: usize,
    /// Identifier with [`EFF_FLAG`].
    pub can_id: u32,
    /// How it is read.
    pub codec: Codec,
    /// Where it goes.
    pub to: LocatedAddress,
    /// Byte of %I for the quality.
    pub status_byte: Option<u32>,
    /// Older is bad.
    pub timeout_ns: Option<u64>,
    /// Value while bad; `None` holds the last one.
    pub substitute: Option<[u8; 8]>,
}

/// A signal of a frame sent, ready to run.
#[derive(Debug, Clone)]
pub struct OutputPoint {
    /// How it is written.
    pub codec: Codec,
    /// Where it comes from.
    pub from: LocatedAddress,
}

/// What a frame does in the safe state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Safe {
    /// Nothing is sent.
    Silent,
    /// Cyclic frames go on unchanged.
    Hold,
    /// This is sent.
    Payload([u8; 64]),
}

/// A frame sent, ready to run.
#[derive(Debug, Clone)]
pub struct OutputFrame {
    /// Index of its `[[service.out]]`.
    pub index: usize,
    /// Identifier with [`EFF_FLAG`].
    pub can_id: u32,
    /// Bytes.
    pub len: u8,
    /// `fd_flags` of the frame: 0, FDF or FDF + BRS.
    pub fd_flags: u8,
    /// Cyclic with this period, or on change.
    pub period_ns: Option<u64>,
    /// Least time between frames on change.
    pub inhibit_ns: u64,
    /// Bytes before signals are written.
    pub fill: u8,
    /// Safe state.
    pub safe: Safe,
    /// Its signals.
    pub signals: Vec<OutputPoint>,
}

/// Everything the service does.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// In order of the stack file.
    pub inputs: Vec<InputPoint>,
    /// In order of the stack file.
    pub outputs: Vec<OutputFrame>,
    /// Empty: the plan can run.
    pub mistakes: Vec<Mistake>,
}

struct Mistakes(Vec<Mistake>);

impl Mistakes {
    fn add(&mut self, key: &str, message: impl Into<String>, help: impl Into<String>) {
        self.0.push(Mistake { key: key.to_owned(), message: message.into(), help: help.into() });
    }
}

/// Resolves the table; its addresses count as those of the plc. Entries with a mistake are left out of the plan.
pub fn plan(config: &Config, addressing: Addressing) -> Plan {
    let mut mistakes = Mistakes(Vec::new());
    for (what, count, limit) in
        [("in", config.inputs.len(), MAX_INPUTS), ("out", config.outputs.len(), MAX_OUTPUTS)]
    {
        if count > limit {
            let message = format!("{count} entries: a can-io service has at most {limit}");
            mistakes.add(what, message, "split them over two can-io services");
        }
    }
    let inputs: Vec<_> = config
        .inputs
        .iter()
        .take(MAX_INPUTS)
        .enumerate()
        .filter_map(|(index, input)| plan_input(addressing, index, input, &mut mistakes))
        .collect();
    let outputs: Vec<_> = config
        .outputs
        .iter()
        .take(MAX_OUTPUTS)
        .enumerate()
        .filter_map(|(index, output)| plan_output(addressing, index, output, &mut mistakes))
        .collect();
    overlaps(&inputs, &mut mistakes);
    for (i, frame) in outputs.iter().enumerate() {
        if let Some(other) = outputs[..i].iter().find(|other| other.can_id == frame.can_id) {
            let message = format!("{} is sent by out[{}] too", id_text(frame.can_id), other.index);
            mistakes.add(
                &format!("out[{}].id", frame.index),
                message,
                "put all signals of a frame into one entry",
            );
        }
    }
    Plan { inputs, outputs, mistakes: mistakes.0 }
}

/// `123h` or `18FEF100h`.
pub fn id_text(can_id: u32) -> String {
    if can_id & EFF_FLAG != 0 { format!("{:08X}h", can_id & !EFF_FLAG) } else { format!("{can_id:03X}h") }
}

fn can_id(id: Id, ext: Option<bool>, key: &str, mistakes: &mut Mistakes) -> Option<u32> {
    let extended = ext.unwrap_or(id.extended);
    let limit = if extended { 0x1FFF_FFFF } else { 0x7FF };
    if id.value > limit {
        let (bits, help) = if extended {
            (29, "use at most 1FFFFFFF")
        } else {
            (11, "use at most 7FF, or ext = true for 29 bits")
        };
        mistakes.add(
            &format!("{key}.id"),
            format!("identifier {:X} does not fit in {bits} bits", id.value),
            help,
        );
        return None;
    }
    Some(if extended { id.value | EFF_FLAG } else { id.value })
}

/// The parts that inputs and outputs have in common.
struct Bits<'a> {
    start: u32,
    len: u32,
    order: ByteOrder,
    signed: bool,
    float: bool,
    scale: f64,
    offset: f64,
    address: &'a str,
    iec: Option<IecType>,
}

fn codec(
    addressing: Addressing,
    bits: &Bits<'_>,
    areas: &[AreaKind],
    (key, place): (&str, &str),
    mistakes: &mut Mistakes,
) -> Option<(Codec, LocatedAddress)> {
    let before = mistakes.0.len();
    let signal = Signal::new(bits.start, bits.len, bits.order)
        .map_err(|e| {
            mistakes.add(&format!("{key}.len"), e.to_string(), "see the DBC numbering of start and len");
        })
        .ok();
    if bits.float && !matches!(bits.len, 32 | 64) {
        let message = format!("a float signal has 32 or 64 bits, not {}", bits.len);
        mistakes.add(&format!("{key}.float"), message, "set len = 32 or 64, or float = false");
    }
    if bits.scale == 0.0 || !bits.scale.is_finite() || !bits.offset.is_finite() {
        let message = format!("scale {} and offset {} make no value", bits.scale, bits.offset);
        mistakes.add(&format!("{key}.scale"), message, "scale must not be 0, and both must be finite");
    }
    let place_key = format!("{key}.{place}");
    let address = match parse_address(bits.address, addressing) {
        Ok(address) if areas.contains(&address.area) => Some(address),
        Ok(_) if areas == [AreaKind::Input] => {
            let message = format!("{} is no input: values from the bus go to %I", bits.address);
            mistakes.add(&place_key, message, "write %I..., and copy it in the program or by a route");
            None
        }
        Ok(_) => {
            let message = format!("{} is no output: values to the bus come from %Q or %M", bits.address);
            mistakes.add(&place_key, message, "write %Q... or %M...");
            None
        }
        Err(e) => {
            mistakes.add(
                &place_key,
                e.to_string(),
                "the plc service's `addressing` says how numbers are counted",
            );
            None
        }
    }?;
    let size = address.size;
    let iec = bits.iec.unwrap_or_else(|| default_type(size, bits.signed));
    if iec.bits() != size.bits() {
        let message = format!("{} has {} bits, {} has {}", bits.address, size.bits(), iec.name(), iec.bits());
        mistakes.add(&format!("{key}.type"), message, "use X for BOOL, B, W, D, L for 8, 16, 32, 64 bits");
    }
    let raw = match (bits.float, bits.signed) {
        (true, _) => Raw::Float,
        (false, true) => Raw::Signed,
        (false, false) => Raw::Unsigned,
    };
    let codec = Codec { signal: signal?, raw, scale: bits.scale, offset: bits.offset, iec };
    (mistakes.0.len() == before).then_some((codec, address))
}

fn default_type(size: AddressSize, signed: bool) -> IecType {
    match (size, signed) {
        (AddressSize::Bit, _) => IecType::Bool,
        (AddressSize::Byte, false) => IecType::Usint,
        (AddressSize::Byte, true) => IecType::Sint,
        (AddressSize::Word, false) => IecType::Uint,
        (AddressSize::Word, true) => IecType::Int,
        (AddressSize::Dword, false) => IecType::Udint,
        (AddressSize::Dword, true) => IecType::Dint,
        (AddressSize::Lword, false) => IecType::Ulint,
        (AddressSize::Lword, true) => IecType::Lint,
    }
}

fn plan_input(
    addressing: Addressing,
    index: usize,
    input: &Input,
    mistakes: &mut Mistakes,
) -> Option<InputPoint> {
    let key = format!("in[{index}]");
    let can_id = can_id(input.id, input.ext, &key, mistakes);
    let bits = Bits {
        start: input.start,
        len: input.len,
        order: input.order,
        signed: input.signed,
        float: input.float,
        scale: input.scale,
        offset: input.offset,
        address: &input.to,
        iec: input.iec,
    };
    let resolved = codec(addressing, &bits, &[AreaKind::Input], (&key, "to"), mistakes);
    if input.timeout.is_some_and(|t| t.ns() < 1_000_000) {
        mistakes.add(&format!("{key}.timeout"), "a timeout below 1ms is no timeout", "use at least 1ms");
    }
    let status = input.status_to.as_deref().map(|text| {
        let found = parse_address(text, addressing).ok();
        let byte = found.filter(|a| a.area == AreaKind::Input && a.size == AddressSize::Byte).map(|a| a.byte);
        if byte.is_none() {
            let message = format!("'{text}' is no byte of the inputs");
            mistakes.add(&format!("{key}.status_to"), message, "write %IB and a number, as %IB10");
        }
        byte
    });
    let (codec, to) = resolved?;
    let substitute = match input.on_bad {
        OnBadValue::Word(OnBadWord::Hold) => None,
        OnBadValue::Word(OnBadWord::Zero) => Some([0; 8]),
        OnBadValue::Value(value) => Some(codec.substitute(value)),
    };
    let timeout_ns = input.timeout.map(|t| t.ns());
    Some(InputPoint {
        index,
        can_id: can_id?,
        codec,
        to,
        status_byte: status.flatten(),
        timeout_ns,
        substitute,
    })
}

fn plan_output(
    addressing: Addressing,
    index: usize,
    output: &Output,
    mistakes: &mut Mistakes,
) -> Option<OutputFrame> {
    let key = format!("out[{index}]");
    let before = mistakes.0.len();
    let can_id = can_id(output.id, output.ext, &key, mistakes);
    let fd = output.fd.unwrap_or(output.dlc > 8);
    let possible: &[u32] = if fd {
        &[0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]
    } else {
        &[0, 1, 2, 3, 4, 5, 6, 7, 8]
    };
    if !possible.contains(&output.dlc) {
        let message =
            format!("a {} frame has no {} bytes", if fd { "CAN FD" } else { "classic" }, output.dlc);
        mistakes.add(
            &format!("{key}.dlc"),
            message,
            "use 0 to 8, for CAN FD also 12, 16, 20, 24, 32, 48 or 64",
        );
    }
    if output.brs && !fd {
        mistakes.add(
            &format!("{key}.brs"),
            "only CAN FD switches the bit rate",
            "set fd = true, or remove brs",
        );
    }
    check_timing(output, &key, mistakes);
    if output.signals.len() > MAX_SIGNALS {
        let message = format!("{} signals: a frame has at most {MAX_SIGNALS}", output.signals.len());
        mistakes.add(&format!("{key}.signals"), message, "send them in two frames");
    }
    let signals = plan_signals(addressing, output, &key, mistakes);
    let safe = safe_state(output, &signals, &key, mistakes);
    let frame = OutputFrame {
        index,
        can_id: can_id?,
        len: output.dlc as u8,
        fd_flags: if fd { 4 | u8::from(output.brs) } else { 0 },
        period_ns: output.period.map(|p| p.ns()),
        inhibit_ns: output.inhibit.ns(),
        fill: output.fill,
        safe,
        signals,
    };
    (mistakes.0.len() == before).then_some(frame)
}

/// A cyclic frame has a period, one sent on change has not.
fn check_timing(output: &Output, key: &str, mistakes: &mut Mistakes) {
    match (output.mode, output.period.map(|p| p.ns())) {
        (Mode::Cyclic, Some(1_000_000..)) | (Mode::OnChange, None) => {}
        (Mode::Cyclic, _) => {
            mistakes.add(
                &format!("{key}.period"),
                "a cyclic frame needs a period of at least 1ms",
                "add period = \"100ms\"",
            );
        }
        (Mode::OnChange, Some(_)) => {
            let help = "remove it, or use mode = \"cyclic\"";
            mistakes.add(&format!("{key}.period"), "a frame sent on change has no period", help);
        }
    }
    if output.mode == Mode::Cyclic && output.inhibit.ns() > 0 {
        let help = "remove it, or use mode = \"on_change\"";
        mistakes.add(&format!("{key}.inhibit"), "a cyclic frame has no inhibit time", help);
    }
}

fn plan_signals(
    addressing: Addressing,
    output: &Output,
    key: &str,
    mistakes: &mut Mistakes,
) -> Vec<OutputPoint> {
    let mut signals = Vec::new();
    let mut covered = [0u8; 64];
    for (i, signal) in output.signals.iter().take(MAX_SIGNALS).enumerate() {
        let key = format!("{key}.signals[{i}]");
        let Some(point) = plan_signal(addressing, signal, &key, mistakes) else { continue };
        let layout = point.codec.signal;
        if layout.frame_bytes() > output.dlc as usize {
            let message =
                format!("{} needs {} bytes, dlc is {}", layout.label(), layout.frame_bytes(), output.dlc);
            mistakes.add(&format!("{key}.start"), message, "set dlc higher, or start or len lower");
            continue;
        }
        let mut own = [0u8; 64];
        layout.insert(&mut own, u64::MAX);
        if own.iter().zip(&covered).any(|(a, b)| a & b != 0) {
            let message = format!("{} lies over another signal of the frame", layout.label());
            mistakes.add(&format!("{key}.start"), message, "give every bit to one signal only");
        }
        covered.iter_mut().zip(&own).for_each(|(a, b)| *a |= b);
        signals.push(point);
    }
    signals
}

fn plan_signal(
    addressing: Addressing,
    signal: &OutputSignal,
    key: &str,
    mistakes: &mut Mistakes,
) -> Option<OutputPoint> {
    let bits = Bits {
        start: signal.start,
        len: signal.len,
        order: signal.order,
        signed: signal.signed,
        float: signal.float,
        scale: signal.scale,
        offset: signal.offset,
        address: &signal.from,
        iec: signal.iec,
    };
    let (codec, from) =
        codec(addressing, &bits, &[AreaKind::Output, AreaKind::Marker], (key, "from"), mistakes)?;
    Some(OutputPoint { codec, from })
}

fn safe_state(output: &Output, signals: &[OutputPoint], key: &str, mistakes: &mut Mistakes) -> Safe {
    let mut payload = [output.fill; 64];
    match &output.on_stop {
        OnStop::Word(OnStopWord::Silent) => Safe::Silent,
        OnStop::Word(OnStopWord::Hold) => Safe::Hold,
        OnStop::Word(OnStopWord::NotAvailable) => {
            for point in signals {
                point.codec.signal.insert(&mut payload, u64::MAX);
            }
            Safe::Payload(payload)
        }
        OnStop::Values(stop) => {
            if stop.values.len() != output.signals.len() || stop.values.iter().any(|v| !v.is_finite()) {
                let message = format!("{} values for {} signals", stop.values.len(), output.signals.len());
                mistakes.add(
                    &format!("{key}.on_stop"),
                    message,
                    "give one finite number per signal, in their order",
                );
            }
            for (point, value) in signals.iter().zip(&stop.values) {
                point.codec.encode_physical(*value, &mut payload);
            }
            Safe::Payload(payload)
        }
    }
}

/// Two inputs of this service on one place; the launcher finds those of two services.
fn overlaps(inputs: &[InputPoint], mistakes: &mut Mistakes) {
    let span = |point: &InputPoint| {
        let first = point.to.byte * 8 + u32::from(point.to.bit.unwrap_or(0));
        (first, first + point.to.size.bits())
    };
    let mut sorted: Vec<&InputPoint> = inputs.iter().collect();
    sorted.sort_by_key(|point| (span(point), point.index));
    for pair in sorted.windows(2) {
        if span(pair[1]).0 < span(pair[0]).1 {
            let (low, high) = (pair[0].index.min(pair[1].index), pair[0].index.max(pair[1].index));
            let message = format!("lies over in[{low}].to");
            mistakes.add(&format!("in[{high}].to"), message, "give every bit of %I to one input only");
        }
    }
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;
