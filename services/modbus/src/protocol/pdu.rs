//! The protocol data unit: function code and data, the same on TCP, RTU and ASCII.
//!
//! [`decode_request`] makes the first two checks the specification asks of a server, in its order (V1.1b3
//! figure 9): is the function code supported (else exception 01), are quantity, byte count and value legal
//! (else 03). The other two, address (02) and execution (04), need the device and belong to
//! [`crate::server`].

use super::wire::{Writer, u16_at};
use super::{diagnostics, files, identification};

/// Largest PDU in bytes: 256 bytes of serial ADU less address and CRC (V1.1b3 clause 4.1).
pub const MAX_PDU: usize = 253;
/// Most coils or discrete inputs read at once (V1.1b3 clauses 6.1 and 6.2: 0x07D0).
pub const MAX_READ_BITS: u16 = 2000;
/// Most registers read at once (V1.1b3 clauses 6.3, 6.4 and 6.17: 0x007D).
pub const MAX_READ_WORDS: u16 = 125;
/// Most coils written at once (V1.1b3 clause 6.11: 0x07B0).
pub const MAX_WRITE_BITS: u16 = 1968;
/// Most registers written at once (V1.1b3 clause 6.12: 0x007B).
pub const MAX_WRITE_WORDS: u16 = 123;
/// Most registers written by function 23 (V1.1b3 clause 6.17: 0x0079).
pub const MAX_READ_WRITE_WORDS: u16 = 121;
/// The value that switches a coil on (V1.1b3 clause 6.5); 0x0000 switches it off, all others are illegal.
pub const COIL_ON: u16 = 0xFF00;
/// Set in the function code of an exception response (V1.1b3 clause 7).
pub const EXCEPTION_BIT: u8 = 0x80;

/// The public function codes (V1.1b3 clause 5.1).
pub mod function {
    /// Read coils, clause 6.1.
    pub const READ_COILS: u8 = 1;
    /// Read discrete inputs, clause 6.2.
    pub const READ_DISCRETE_INPUTS: u8 = 2;
    /// Read holding registers, clause 6.3.
    pub const READ_HOLDING_REGISTERS: u8 = 3;
    /// Read input registers, clause 6.4.
    pub const READ_INPUT_REGISTERS: u8 = 4;
    /// Write single coil, clause 6.5.
    pub const WRITE_SINGLE_COIL: u8 = 5;
    /// Write single register, clause 6.6.
    pub const WRITE_SINGLE_REGISTER: u8 = 6;
    /// Read exception status, serial line only, clause 6.7.
    pub const READ_EXCEPTION_STATUS: u8 = 7;
    /// Diagnostics, serial line only, clause 6.8.
    pub const DIAGNOSTICS: u8 = 8;
    /// Get comm event counter, serial line only, clause 6.9.
    pub const GET_COMM_EVENT_COUNTER: u8 = 11;
    /// Get comm event log, serial line only, clause 6.10.
    pub const GET_COMM_EVENT_LOG: u8 = 12;
    /// Write multiple coils, clause 6.11.
    pub const WRITE_MULTIPLE_COILS: u8 = 15;
    /// Write multiple registers, clause 6.12.
    pub const WRITE_MULTIPLE_REGISTERS: u8 = 16;
    /// Report server ID, serial line only, clause 6.13.
    pub const REPORT_SERVER_ID: u8 = 17;
    /// Read file record, clause 6.14.
    pub const READ_FILE_RECORD: u8 = 20;
    /// Write file record, clause 6.15.
    pub const WRITE_FILE_RECORD: u8 = 21;
    /// Mask write register, clause 6.16.
    pub const MASK_WRITE_REGISTER: u8 = 22;
    /// Read/write multiple registers, clause 6.17.
    pub const READ_WRITE_MULTIPLE_REGISTERS: u8 = 23;
    /// Read FIFO queue, clause 6.18.
    pub const READ_FIFO_QUEUE: u8 = 24;
    /// Encapsulated interface transport, clause 6.19.
    pub const ENCAPSULATED_INTERFACE: u8 = 43;

    /// Whether V1.1b3 marks the code as one for serial lines only.
    pub fn is_serial_line_only(code: u8) -> bool {
        matches!(
            code,
            READ_EXCEPTION_STATUS
                | DIAGNOSTICS
                | GET_COMM_EVENT_COUNTER
                | GET_COMM_EVENT_LOG
                | REPORT_SERVER_ID
        )
    }
}

/// Name of a public function code as V1.1b3 clause 5.1 writes it; `None` for codes that are not public.
pub fn function_name(code: u8) -> Option<&'static str> {
    Some(match code {
        1 => "Read Coils",
        2 => "Read Discrete Inputs",
        3 => "Read Holding Registers",
        4 => "Read Input Registers",
        5 => "Write Single Coil",
        6 => "Write Single Register",
        7 => "Read Exception Status",
        8 => "Diagnostics",
        11 => "Get Comm Event Counter",
        12 => "Get Comm Event Log",
        15 => "Write Multiple Coils",
        16 => "Write Multiple Registers",
        17 => "Report Server ID",
        20 => "Read File Record",
        21 => "Write File Record",
        22 => "Mask Write Register",
        23 => "Read/Write Multiple Registers",
        24 => "Read FIFO Queue",
        43 => "Encapsulated Interface Transport",
        _ => return None,
    })
}

/// Exception codes (V1.1b3 clause 7).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Exception {
    /// 01: the function code is not served.
    IllegalFunction = 0x01,
    /// 02: an address of the request is not in the map, or may not be written.
    IllegalDataAddress = 0x02,
    /// 03: quantity, byte count, value or length of the request is illegal.
    IllegalDataValue = 0x03,
    /// 04: the request is right but cannot be carried out now.
    ServerDeviceFailure = 0x04,
    /// 05: accepted, takes long (programming commands).
    Acknowledge = 0x05,
    /// 06: try again, a queue is full.
    ServerDeviceBusy = 0x06,
    /// 07: the request cannot be performed (programming commands; V1.1b3 counts it in 8/10h).
    NegativeAcknowledge = 0x07,
    /// 08: a file record is damaged.
    MemoryParityError = 0x08,
    /// 0A: the unit addressed is not configured here.
    GatewayPathUnavailable = 0x0A,
    /// 0B: the unit addressed did not answer.
    GatewayTargetFailedToRespond = 0x0B,
}

impl Exception {
    /// The code on the wire.
    pub fn code(self) -> u8 {
        self as u8
    }

    /// The exception with this code, if it is one of V1.1b3 clause 7.
    pub fn from_code(code: u8) -> Option<Self> {
        Some(match code {
            0x01 => Self::IllegalFunction,
            0x02 => Self::IllegalDataAddress,
            0x03 => Self::IllegalDataValue,
            0x04 => Self::ServerDeviceFailure,
            0x05 => Self::Acknowledge,
            0x06 => Self::ServerDeviceBusy,
            0x07 => Self::NegativeAcknowledge,
            0x08 => Self::MemoryParityError,
            0x0A => Self::GatewayPathUnavailable,
            0x0B => Self::GatewayTargetFailedToRespond,
            _ => return None,
        })
    }
}

/// A legal request. Addresses are the 0-based ones of the PDU (V1.1b3 clause 4.4). Coil values are packed
/// low bit first as on the wire, register values are the wire's big-endian bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request<'a> {
    /// Function 1, quantity 1-2000.
    ReadCoils { address: u16, quantity: u16 },
    /// Function 2, quantity 1-2000.
    ReadDiscreteInputs { address: u16, quantity: u16 },
    /// Function 3, quantity 1-125.
    ReadHoldingRegisters { address: u16, quantity: u16 },
    /// Function 4, quantity 1-125.
    ReadInputRegisters { address: u16, quantity: u16 },
    /// Function 5.
    WriteSingleCoil { address: u16, on: bool },
    /// Function 6.
    WriteSingleRegister { address: u16, value: u16 },
    /// Function 15, quantity 1-1968, `values` = ceil(quantity / 8) bytes.
    WriteMultipleCoils { address: u16, quantity: u16, values: &'a [u8] },
    /// Function 16, `values` = 2 bytes a register, 1-123 registers.
    WriteMultipleRegisters { address: u16, values: &'a [u8] },
    /// Function 22: register = (register AND `and_mask`) OR (`or_mask` AND NOT `and_mask`).
    MaskWriteRegister { address: u16, and_mask: u16, or_mask: u16 },
    /// Function 23, write (1-121 registers) before read (1-125).
    ReadWriteMultipleRegisters { read_address: u16, read_quantity: u16, write_address: u16, values: &'a [u8] },
    /// Function 7.
    ReadExceptionStatus,
    /// Function 8, sub-functions of [`diagnostics::sub`].
    Diagnostics { sub_function: u16, data: &'a [u8] },
    /// Function 11.
    GetCommEventCounter,
    /// Function 12.
    GetCommEventLog,
    /// Function 17.
    ReportServerId,
    /// Function 20; the groups as [`files::read_groups`] walks them.
    ReadFileRecord { groups: &'a [u8] },
    /// Function 21; the groups as [`files::write_groups`] walks them.
    WriteFileRecord { groups: &'a [u8] },
    /// Function 24.
    ReadFifoQueue { address: u16 },
    /// Function 43, MEI type 14: `code` of [`identification::code`], first or only object.
    ReadDeviceIdentification { code: u8, object: u8 },
    /// Function 43, MEI type 13: what follows the MEI type.
    CanopenGeneralReference { data: &'a [u8] },
}

/// A request that is answered by an exception before the device is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Refused {
    /// Function code of the request.
    pub function: u8,
    /// 01 or 03.
    pub exception: Exception,
}

/// A request or response that cannot be put on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EncodeError {
    /// The caller's buffer is too small.
    #[error("the PDU needs {needed} bytes but the buffer has {got}; give it {MAX_PDU} bytes")]
    Buffer { needed: usize, got: usize },
    /// Quantity, byte count or value outside the limits of the function code.
    #[error(
        "function {function} cannot carry this quantity or these values; see the limits of V1.1b3 clause 6"
    )]
    Limits { function: u8 },
}

impl Request<'_> {
    /// Function code on the wire.
    pub fn function(&self) -> u8 {
        match self {
            Self::ReadCoils { .. } => function::READ_COILS,
            Self::ReadDiscreteInputs { .. } => function::READ_DISCRETE_INPUTS,
            Self::ReadHoldingRegisters { .. } => function::READ_HOLDING_REGISTERS,
            Self::ReadInputRegisters { .. } => function::READ_INPUT_REGISTERS,
            Self::WriteSingleCoil { .. } => function::WRITE_SINGLE_COIL,
            Self::WriteSingleRegister { .. } => function::WRITE_SINGLE_REGISTER,
            Self::WriteMultipleCoils { .. } => function::WRITE_MULTIPLE_COILS,
            Self::WriteMultipleRegisters { .. } => function::WRITE_MULTIPLE_REGISTERS,
            Self::MaskWriteRegister { .. } => function::MASK_WRITE_REGISTER,
            Self::ReadWriteMultipleRegisters { .. } => function::READ_WRITE_MULTIPLE_REGISTERS,
            Self::ReadExceptionStatus => function::READ_EXCEPTION_STATUS,
            Self::Diagnostics { .. } => function::DIAGNOSTICS,
            Self::GetCommEventCounter => function::GET_COMM_EVENT_COUNTER,
            Self::GetCommEventLog => function::GET_COMM_EVENT_LOG,
            Self::ReportServerId => function::REPORT_SERVER_ID,
            Self::ReadFileRecord { .. } => function::READ_FILE_RECORD,
            Self::WriteFileRecord { .. } => function::WRITE_FILE_RECORD,
            Self::ReadFifoQueue { .. } => function::READ_FIFO_QUEUE,
            Self::ReadDeviceIdentification { .. } | Self::CanopenGeneralReference { .. } => {
                function::ENCAPSULATED_INTERFACE
            }
        }
    }

    /// Whether the quantities and values are within the limits of the function code.
    fn is_legal(&self) -> bool {
        match *self {
            Self::ReadCoils { quantity, .. } | Self::ReadDiscreteInputs { quantity, .. } => {
                (1..=MAX_READ_BITS).contains(&quantity)
            }
            Self::ReadHoldingRegisters { quantity, .. } | Self::ReadInputRegisters { quantity, .. } => {
                (1..=MAX_READ_WORDS).contains(&quantity)
            }
            Self::WriteSingleCoil { .. }
            | Self::WriteSingleRegister { .. }
            | Self::MaskWriteRegister { .. } => true,
            Self::WriteMultipleCoils { quantity, values, .. } => {
                (1..=MAX_WRITE_BITS).contains(&quantity) && values.len() == bytes_for_bits(quantity)
            }
            Self::WriteMultipleRegisters { values, .. } => is_words(values, MAX_WRITE_WORDS),
            Self::ReadWriteMultipleRegisters { read_quantity, values, .. } => {
                (1..=MAX_READ_WORDS).contains(&read_quantity) && is_words(values, MAX_READ_WRITE_WORDS)
            }
            Self::ReadExceptionStatus
            | Self::GetCommEventCounter
            | Self::GetCommEventLog
            | Self::ReportServerId
            | Self::ReadFifoQueue { .. } => true,
            Self::Diagnostics { sub_function, data } => diagnostics::is_request_data(sub_function, data),
            Self::ReadFileRecord { groups } => files::is_read_request(groups),
            Self::WriteFileRecord { groups } => files::is_write_request(groups),
            Self::ReadDeviceIdentification { code, .. } => {
                (identification::code::BASIC..=identification::code::INDIVIDUAL).contains(&code)
            }
            Self::CanopenGeneralReference { data } => data.len() <= MAX_PDU - 2,
        }
    }
}

fn is_words(values: &[u8], max: u16) -> bool {
    values.len().is_multiple_of(2) && (1..=usize::from(max)).contains(&(values.len() / 2))
}

/// Bytes that `quantity` packed bits take (V1.1b3 clause 6.1: quantity / 8, one more for a remainder).
pub fn bytes_for_bits(quantity: u16) -> usize {
    usize::from(quantity).div_ceil(8)
}

/// Reads a request PDU, function code first.
///
/// Checks in the order of V1.1b3 figure 9: an unknown or obsolete function code, sub-function of function 8 or MEI
/// type of function 43 is refused with exception 01 whatever follows it; then a length that does not fit the
/// function (short or with trailing bytes), a quantity out of range, a byte count that does not fit the quantity,
/// groups that do not fit together, or a value the function does not have with exception 03. An empty PDU (no
/// transport delivers one) counts as function 0.
pub fn decode_request(pdu: &[u8]) -> Result<Request<'_>, Refused> {
    let (function, data) = match pdu.split_first() {
        Some((&function, data)) => (function, data),
        None => return Err(Refused { function: 0, exception: Exception::IllegalFunction }),
    };
    let plain = |request| data.is_empty().then_some(request);
    let request = match function {
        function::READ_COILS..=function::WRITE_SINGLE_REGISTER => decode_two_words(function, data),
        function::READ_EXCEPTION_STATUS => plain(Request::ReadExceptionStatus),
        function::DIAGNOSTICS => match u16_at(data, 0) {
            Some(sub) if !diagnostics::sub::ALL.contains(&sub) => {
                return Err(Refused { function, exception: Exception::IllegalFunction });
            }
            Some(sub_function) => Some(Request::Diagnostics { sub_function, data: &data[2..] }),
            None => None,
        },
        function::GET_COMM_EVENT_COUNTER => plain(Request::GetCommEventCounter),
        function::GET_COMM_EVENT_LOG => plain(Request::GetCommEventLog),
        function::REPORT_SERVER_ID => plain(Request::ReportServerId),
        function::WRITE_MULTIPLE_COILS => decode_write_coils(data),
        function::WRITE_MULTIPLE_REGISTERS => decode_write_registers(data),
        function::READ_FILE_RECORD => {
            counted_values(data, 0).map(|groups| Request::ReadFileRecord { groups })
        }
        function::WRITE_FILE_RECORD => {
            counted_values(data, 0).map(|groups| Request::WriteFileRecord { groups })
        }
        function::MASK_WRITE_REGISTER => decode_mask_write(data),
        function::READ_WRITE_MULTIPLE_REGISTERS => decode_read_write(data),
        function::READ_FIFO_QUEUE => match data {
            &[high, low] => Some(Request::ReadFifoQueue { address: u16::from_be_bytes([high, low]) }),
            _ => None,
        },
        function::ENCAPSULATED_INTERFACE => match data {
            &[identification::MEI_DEVICE_IDENTIFICATION, ref rest @ ..] => match rest {
                &[code, object] => Some(Request::ReadDeviceIdentification { code, object }),
                _ => None,
            },
            &[identification::MEI_CANOPEN, ref data @ ..] => Some(Request::CanopenGeneralReference { data }),
            [] => None,
            _ => return Err(Refused { function, exception: Exception::IllegalFunction }),
        },
        _ => return Err(Refused { function, exception: Exception::IllegalFunction }),
    };
    match request {
        Some(request) if request.is_legal() => Ok(request),
        _ => Err(Refused { function, exception: Exception::IllegalDataValue }),
    }
}

/// Functions 1 to 6: address and one more word, nothing else.
fn decode_two_words(function: u8, data: &[u8]) -> Option<Request<'_>> {
    let &[a, b, c, d] = data else { return None };
    let (address, word) = (u16::from_be_bytes([a, b]), u16::from_be_bytes([c, d]));
    Some(match function {
        function::READ_COILS => Request::ReadCoils { address, quantity: word },
        function::READ_DISCRETE_INPUTS => Request::ReadDiscreteInputs { address, quantity: word },
        function::READ_HOLDING_REGISTERS => Request::ReadHoldingRegisters { address, quantity: word },
        function::READ_INPUT_REGISTERS => Request::ReadInputRegisters { address, quantity: word },
        function::WRITE_SINGLE_COIL => match word {
            COIL_ON => Request::WriteSingleCoil { address, on: true },
            0 => Request::WriteSingleCoil { address, on: false },
            _ => return None,
        },
        _ => Request::WriteSingleRegister { address, value: word },
    })
}

/// Splits off a byte count at `at` and the values behind it, which must end with the PDU.
fn counted_values(data: &[u8], at: usize) -> Option<&[u8]> {
    let count = usize::from(*data.get(at)?);
    let values = data.get(at + 1..)?;
    (values.len() == count).then_some(values)
}

fn decode_write_coils(data: &[u8]) -> Option<Request<'_>> {
    let (address, quantity) = (u16_at(data, 0)?, u16_at(data, 2)?);
    Some(Request::WriteMultipleCoils { address, quantity, values: counted_values(data, 4)? })
}

fn decode_write_registers(data: &[u8]) -> Option<Request<'_>> {
    let (address, quantity) = (u16_at(data, 0)?, u16_at(data, 2)?);
    let values = counted_values(data, 4)?;
    (values.len() == usize::from(quantity) * 2).then_some(Request::WriteMultipleRegisters { address, values })
}

fn decode_mask_write(data: &[u8]) -> Option<Request<'_>> {
    let request = Request::MaskWriteRegister {
        address: u16_at(data, 0)?,
        and_mask: u16_at(data, 2)?,
        or_mask: u16_at(data, 4)?,
    };
    (data.len() == 6).then_some(request)
}

fn decode_read_write(data: &[u8]) -> Option<Request<'_>> {
    let write_quantity = u16_at(data, 6)?;
    let values = counted_values(data, 8)?;
    let request = Request::ReadWriteMultipleRegisters {
        read_address: u16_at(data, 0)?,
        read_quantity: u16_at(data, 2)?,
        write_address: u16_at(data, 4)?,
        values,
    };
    (values.len() == usize::from(write_quantity) * 2).then_some(request)
}

/// Writes a request PDU into `out` ([`MAX_PDU`] bytes always suffice) and returns its length.
pub fn encode_request(request: &Request<'_>, out: &mut [u8]) -> Result<usize, EncodeError> {
    if !request.is_legal() {
        return Err(EncodeError::Limits { function: request.function() });
    }
    let mut w = Writer::new(out);
    w.u8(request.function())?;
    match *request {
        Request::ReadCoils { address, quantity }
        | Request::ReadDiscreteInputs { address, quantity }
        | Request::ReadHoldingRegisters { address, quantity }
        | Request::ReadInputRegisters { address, quantity } => {
            w.u16(address)?;
            w.u16(quantity)?;
        }
        Request::WriteSingleCoil { address, on } => {
            w.u16(address)?;
            w.u16(if on { COIL_ON } else { 0 })?;
        }
        Request::WriteSingleRegister { address, value } => {
            w.u16(address)?;
            w.u16(value)?;
        }
        Request::WriteMultipleCoils { address, quantity, values } => {
            w.u16(address)?;
            w.u16(quantity)?;
            w.u8(values.len() as u8)?;
            w.bytes(values)?;
        }
        Request::WriteMultipleRegisters { address, values } => {
            w.u16(address)?;
            w.u16((values.len() / 2) as u16)?;
            w.u8(values.len() as u8)?;
            w.bytes(values)?;
        }
        Request::MaskWriteRegister { address, and_mask, or_mask } => {
            w.u16(address)?;
            w.u16(and_mask)?;
            w.u16(or_mask)?;
        }
        Request::ReadWriteMultipleRegisters { read_address, read_quantity, write_address, values } => {
            w.u16(read_address)?;
            w.u16(read_quantity)?;
            w.u16(write_address)?;
            w.u16((values.len() / 2) as u16)?;
            w.u8(values.len() as u8)?;
            w.bytes(values)?;
        }
        Request::ReadExceptionStatus
        | Request::GetCommEventCounter
        | Request::GetCommEventLog
        | Request::ReportServerId => {}
        Request::Diagnostics { sub_function, data } => {
            w.u16(sub_function)?;
            w.bytes(data)?;
        }
        Request::ReadFileRecord { groups } | Request::WriteFileRecord { groups } => {
            w.u8(groups.len() as u8)?;
            w.bytes(groups)?;
        }
        Request::ReadFifoQueue { address } => w.u16(address)?,
        Request::ReadDeviceIdentification { code, object } => {
            w.bytes(&[identification::MEI_DEVICE_IDENTIFICATION, code, object])?;
        }
        Request::CanopenGeneralReference { data } => {
            w.u8(identification::MEI_CANOPEN)?;
            w.bytes(data)?;
        }
    }
    Ok(w.len())
}

/// Writes the two bytes of an exception response (V1.1b3 clause 7) into `out`. The function code is the
/// request's with its top bit set; a request whose code had that bit already keeps it.
pub fn encode_exception(function: u8, exception: Exception, out: &mut [u8]) -> Result<usize, EncodeError> {
    let mut w = Writer::new(out);
    w.bytes(&[function | EXCEPTION_BIT, exception.code()])?;
    Ok(w.len())
}

#[cfg(test)]
#[path = "pdu_tests.rs"]
mod tests;
