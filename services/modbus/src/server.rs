//! The server role: one request PDU in, one response PDU out.
//!
//! [`answer`] carries out the state diagrams of V1.1b3 clause 6 for every transport. It knows no clock, no
//! socket and no rail; what the registers are is the business of an [`Image`]. It allocates nothing.

use crate::identity::Identity;
use crate::line_state::{Diagnosed, LineState};
use crate::protocol::files::{self, MAX_FIFO, MAX_RECORD, REFERENCE_TYPE};
use crate::protocol::pdu::{
    EncodeError, Exception, MAX_PDU, Request, bytes_for_bits, decode_request, encode_exception, function,
};
use crate::protocol::{MAX_EVENTS, Response, encode_response};

/// One of the four primary tables (V1.1b3 clause 4.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Table {
    /// Single bits, read and written: functions 1, 5, 15; numbers 0xxxx.
    #[serde(alias = "coil")]
    Coils,
    /// Single bits, read only: function 2; numbers 1xxxx.
    #[serde(alias = "discrete")]
    DiscreteInputs,
    /// 16-bit words, read only: function 4; numbers 3xxxx.
    #[serde(alias = "input")]
    InputRegisters,
    /// 16-bit words, read and written: functions 3, 6, 16, 22, 23; numbers 4xxxx.
    #[serde(alias = "holding")]
    HoldingRegisters,
}

impl Table {
    /// All four.
    pub const ALL: [Self; 4] =
        [Self::Coils, Self::DiscreteInputs, Self::InputRegisters, Self::HoldingRegisters];

    /// Whether its entries are single bits.
    pub fn is_bits(self) -> bool {
        matches!(self, Self::Coils | Self::DiscreteInputs)
    }

    /// Name as in the stack file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Coils => "coils",
            Self::DiscreteInputs => "discrete_inputs",
            Self::InputRegisters => "input_registers",
            Self::HoldingRegisters => "holding_registers",
        }
    }

    /// First digit of the traditional numbers: 0xxxx, 1xxxx, 3xxxx, 4xxxx.
    pub fn digit(self) -> u8 {
        match self {
            Self::Coils => 0,
            Self::DiscreteInputs => 1,
            Self::InputRegisters => 3,
            Self::HoldingRegisters => 4,
        }
    }
}

/// What a request wants to do with a range.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    Read,
    Write,
}

/// One write request, carried out whole or not at all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Write<'a> {
    /// Functions 5 and 15: bits packed low bit first, `quantity` of them.
    Coils { address: u16, quantity: u16, values: &'a [u8] },
    /// Functions 6, 16 and the write half of 23: big-endian words.
    Registers { address: u16, values: &'a [u8] },
    /// Function 22: register = (register AND `and_mask`) OR (`or_mask` AND NOT `and_mask`).
    Mask { address: u16, and_mask: u16, or_mask: u16 },
}

/// The device behind a server.
///
/// [`answer`] asks in this order: [`Image::check`] for every range of the request, [`Image::ready`], then the
/// read or write itself. A range that passed `check` is within the table, so `read_*` and `write` fail only
/// for reasons of execution.
pub trait Image {
    /// Whether the range exists and may be accessed so. `quantity` is at least 1; `address + quantity` may
    /// exceed 65536. Err: [`Exception::IllegalDataAddress`].
    fn check(&self, access: Access, table: Table, address: u16, quantity: u16) -> Result<(), Exception>;

    /// Whether the device can read or write now. Err: [`Exception::ServerDeviceFailure`].
    fn ready(&self, access: Access) -> Result<(), Exception>;

    /// Packs `quantity` bits into `out` (ceil(quantity / 8) bytes), low bit first, unused bits zero.
    fn read_bits(
        &mut self,
        table: Table,
        address: u16,
        quantity: u16,
        out: &mut [u8],
    ) -> Result<(), Exception>;

    /// Puts words into `out`, two bytes each, high byte first.
    fn read_words(&mut self, table: Table, address: u16, out: &mut [u8]) -> Result<(), Exception>;

    /// Carries out or queues a write, whole. A read that follows must see it.
    /// Err: [`Exception::ServerDeviceBusy`] when a queue is full.
    fn write(&mut self, write: &Write<'_>) -> Result<(), Exception>;

    /// Which register map the requests from now on mean, for servers whose units have maps of their own.
    fn select(&mut self, _map: usize) {}

    /// The eight bits of function 7, where the device has them.
    fn exception_status(&mut self) -> Result<u8, Exception> {
        Ok(0)
    }

    /// Whether the device runs: the indicator of function 17.
    fn is_running(&self) -> bool {
        self.ready(Access::Read).is_ok()
    }

    /// Whether these records exist and may be accessed so. Err: [`Exception::IllegalDataAddress`].
    fn check_file(&self, _access: Access, _file: u16, _record: u16, _count: u16) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }

    /// Puts records into `out`, two bytes each, high byte first.
    fn read_file(&mut self, _file: u16, _record: u16, _out: &mut [u8]) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }

    /// Carries out or queues a write of file records, all groups of it or none; see [`files::write_groups`].
    fn write_files(&mut self, _groups: &[u8]) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }

    /// Whether there is a FIFO queue at this address. Err: [`Exception::IllegalDataAddress`].
    fn check_fifo(&self, _address: u16) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }

    /// Puts the registers of a FIFO queue into `out`, high byte first, without taking them out, and returns how
    /// many. Err: [`Exception::IllegalDataValue`] when it says it holds more than 31 (V1.1b3 clause 6.18).
    fn read_fifo(&mut self, _address: u16, _out: &mut [u8; 2 * MAX_FIFO]) -> Result<usize, Exception> {
        Err(Exception::IllegalDataAddress)
    }
}

/// What [`answer`] needs besides the image.
pub struct Unit<'a> {
    /// Counters, log and mode of the unit on its transport.
    pub line: &'a mut LineState,
    pub identity: &'a Identity,
}

/// What became of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Length of the response PDU, at least 2; 0 for no response (listen-only mode was entered or left).
    pub len: usize,
    /// Function code of the request.
    pub function: u8,
    /// Set when the response is an exception.
    pub exception: Option<Exception>,
    /// Whether the request wrote (and was not refused).
    pub wrote: bool,
}

/// Answers one request PDU.
///
/// Order of checks as in V1.1b3 figure 9 and the diagrams of clause 6: function code (01), quantity, byte count
/// and value (03), address (02), execution (04 or what the image says). Function 23 writes before it reads
/// (clause 6.17), and only after both of its ranges were found. The CANopen general reference (43/13) needs a
/// CANopen network and is refused with exception 01.
pub fn answer(
    request: &[u8],
    unit: &mut Unit<'_>,
    image: &mut dyn Image,
    out: &mut [u8; MAX_PDU],
) -> Outcome {
    let refused = match decode_request(request) {
        Ok(request) => match execute(&request, unit, image, out) {
            Ok(len) => {
                return Outcome {
                    len,
                    function: request.function(),
                    exception: None,
                    wrote: writes(&request),
                };
            }
            Err(exception) => (request.function(), exception),
        },
        Err(refused) => (refused.function, refused.exception),
    };
    refuse(refused.0, refused.1, out)
}

/// The exception response to a request that is not carried out.
pub fn refuse(function: u8, exception: Exception, out: &mut [u8; MAX_PDU]) -> Outcome {
    // Two bytes always fit into MAX_PDU bytes.
    let len = encode_exception(function, exception, out).unwrap_or(0);
    Outcome { len, function, exception: Some(exception), wrote: false }
}

fn writes(request: &Request<'_>) -> bool {
    matches!(
        request,
        Request::WriteSingleCoil { .. }
            | Request::WriteSingleRegister { .. }
            | Request::WriteMultipleCoils { .. }
            | Request::WriteMultipleRegisters { .. }
            | Request::MaskWriteRegister { .. }
            | Request::ReadWriteMultipleRegisters { .. }
            | Request::WriteFileRecord { .. }
    )
}

fn execute(
    request: &Request<'_>,
    unit: &mut Unit<'_>,
    image: &mut dyn Image,
    out: &mut [u8; MAX_PDU],
) -> Result<usize, Exception> {
    let response = match *request {
        Request::ReadCoils { address, quantity } => return read(Table::Coils, address, quantity, image, out),
        Request::ReadDiscreteInputs { address, quantity } => {
            return read(Table::DiscreteInputs, address, quantity, image, out);
        }
        Request::ReadHoldingRegisters { address, quantity } => {
            return read(Table::HoldingRegisters, address, quantity, image, out);
        }
        Request::ReadInputRegisters { address, quantity } => {
            return read(Table::InputRegisters, address, quantity, image, out);
        }
        Request::WriteSingleCoil { address, on } => {
            write(
                Table::Coils,
                address,
                1,
                &Write::Coils { address, quantity: 1, values: &[u8::from(on)] },
                image,
            )?;
            Response::WriteSingleCoil { address, on }
        }
        Request::WriteSingleRegister { address, value } => {
            let values = value.to_be_bytes();
            write(
                Table::HoldingRegisters,
                address,
                1,
                &Write::Registers { address, values: &values },
                image,
            )?;
            Response::WriteSingleRegister { address, value }
        }
        Request::WriteMultipleCoils { address, quantity, values } => {
            write(Table::Coils, address, quantity, &Write::Coils { address, quantity, values }, image)?;
            Response::WriteMultipleCoils { address, quantity }
        }
        Request::WriteMultipleRegisters { address, values } => {
            let quantity = (values.len() / 2) as u16;
            write(Table::HoldingRegisters, address, quantity, &Write::Registers { address, values }, image)?;
            Response::WriteMultipleRegisters { address, quantity }
        }
        Request::MaskWriteRegister { address, and_mask, or_mask } => {
            write(Table::HoldingRegisters, address, 1, &Write::Mask { address, and_mask, or_mask }, image)?;
            Response::MaskWriteRegister { address, and_mask, or_mask }
        }
        Request::ReadWriteMultipleRegisters { read_address, read_quantity, write_address, values } => {
            let table = Table::HoldingRegisters;
            image.check(Access::Read, table, read_address, read_quantity)?;
            image.check(Access::Write, table, write_address, (values.len() / 2) as u16)?;
            image.ready(Access::Read)?;
            image.ready(Access::Write)?;
            image.write(&Write::Registers { address: write_address, values })?;
            let function = function::READ_WRITE_MULTIPLE_REGISTERS;
            return read_words(function, table, read_address, read_quantity, image, out);
        }
        _ => return execute_special(request, unit, image, out),
    };
    encode_response(&response, out).map_err(too_long)
}

/// The functions beyond tables.
fn execute_special(
    request: &Request<'_>,
    unit: &mut Unit<'_>,
    image: &mut dyn Image,
    out: &mut [u8; MAX_PDU],
) -> Result<usize, Exception> {
    let mut log = [0; MAX_EVENTS];
    let word;
    let response = match *request {
        Request::ReadExceptionStatus => Response::ReadExceptionStatus(image.exception_status()?),
        Request::Diagnostics { sub_function, data } => {
            let first = data.first_chunk::<2>().map_or(0, |first| u16::from_be_bytes(*first));
            match unit.line.diagnose(sub_function, first) {
                Diagnosed::Echo => Response::Diagnostics { sub_function, data },
                Diagnosed::Value(value) => {
                    word = value.to_be_bytes();
                    Response::Diagnostics { sub_function, data: &word }
                }
                Diagnosed::Silent => return Ok(0),
            }
        }
        Request::GetCommEventCounter => {
            Response::GetCommEventCounter { status: 0, events: unit.line.event_count() }
        }
        Request::GetCommEventLog => {
            let len = unit.line.copy_log(&mut log);
            Response::GetCommEventLog {
                status: 0,
                events: unit.line.event_count(),
                messages: unit.line.message_count(),
                log: &log[..len],
            }
        }
        Request::ReportServerId => return Ok(unit.identity.report(image.is_running(), out)),
        Request::ReadFileRecord { groups } => return read_files(groups, image, out),
        Request::WriteFileRecord { groups } => {
            for group in files::write_groups(groups) {
                check_file(Access::Write, group.reference, group.file, group.record, group.count(), image)?;
            }
            image.ready(Access::Write)?;
            image.write_files(groups)?;
            Response::WriteFileRecord { groups }
        }
        Request::ReadFifoQueue { address } => {
            image.check_fifo(address)?;
            image.ready(Access::Read)?;
            let mut values = [0; 2 * MAX_FIFO];
            let count = image.read_fifo(address, &mut values)?;
            let values = values.get(..count * 2).ok_or(Exception::IllegalDataValue)?;
            return encode_response(&Response::ReadFifoQueue(values), out).map_err(too_long);
        }
        Request::ReadDeviceIdentification { code, object } => return unit.identity.read(code, object, out),
        // 43/13 needs a CANopen network, and every other function was served before.
        _ => return Err(Exception::IllegalFunction),
    };
    encode_response(&response, out).map_err(too_long)
}

fn check_file(
    access: Access,
    reference: u8,
    file: u16,
    record: u16,
    count: u16,
    image: &dyn Image,
) -> Result<(), Exception> {
    let last = u32::from(record) + u32::from(count) - 1;
    if reference != REFERENCE_TYPE || file == 0 || last > u32::from(MAX_RECORD) {
        return Err(Exception::IllegalDataAddress);
    }
    image.check_file(access, file, record, count)
}

fn read_files(groups: &[u8], image: &mut dyn Image, out: &mut [u8; MAX_PDU]) -> Result<usize, Exception> {
    for group in files::read_groups(groups) {
        check_file(Access::Read, group.reference, group.file, group.record, group.count, image)?;
    }
    image.ready(Access::Read)?;
    let mut len = 2;
    for group in files::read_groups(groups) {
        let bytes = usize::from(group.count) * 2;
        let slot = out.get_mut(len..len + 2 + bytes).ok_or(Exception::IllegalDataValue)?;
        slot[0] = (1 + bytes) as u8;
        slot[1] = REFERENCE_TYPE;
        image.read_file(group.file, group.record, &mut slot[2..])?;
        len += 2 + bytes;
    }
    out[0] = function::READ_FILE_RECORD;
    out[1] = (len - 2) as u8;
    Ok(len)
}

fn write(
    table: Table,
    address: u16,
    quantity: u16,
    write: &Write<'_>,
    image: &mut dyn Image,
) -> Result<(), Exception> {
    image.check(Access::Write, table, address, quantity)?;
    image.ready(Access::Write)?;
    image.write(write)
}

fn read(
    table: Table,
    address: u16,
    quantity: u16,
    image: &mut dyn Image,
    out: &mut [u8; MAX_PDU],
) -> Result<usize, Exception> {
    image.check(Access::Read, table, address, quantity)?;
    image.ready(Access::Read)?;
    let function = match table {
        Table::Coils => function::READ_COILS,
        Table::DiscreteInputs => function::READ_DISCRETE_INPUTS,
        Table::HoldingRegisters => function::READ_HOLDING_REGISTERS,
        Table::InputRegisters => function::READ_INPUT_REGISTERS,
    };
    if !table.is_bits() {
        return read_words(function, table, address, quantity, image, out);
    }
    let body = open_reply(function, bytes_for_bits(quantity), out)?;
    image.read_bits(table, address, quantity, body)?;
    Ok(2 + body.len())
}

fn read_words(
    function: u8,
    table: Table,
    address: u16,
    quantity: u16,
    image: &mut dyn Image,
    out: &mut [u8; MAX_PDU],
) -> Result<usize, Exception> {
    let body = open_reply(function, usize::from(quantity) * 2, out)?;
    image.read_words(table, address, body)?;
    Ok(2 + body.len())
}

/// Function code and byte count; returns the place of the data, so that the image writes it where it is sent.
fn open_reply(function: u8, count: usize, out: &mut [u8; MAX_PDU]) -> Result<&mut [u8], Exception> {
    out[0] = function;
    out[1] = count as u8;
    out.get_mut(2..2 + count).ok_or(Exception::ServerDeviceFailure)
}

/// Cannot happen: every response to a legal request fits. Answered like any other failure of execution.
fn too_long(_: EncodeError) -> Exception {
    Exception::ServerDeviceFailure
}

#[cfg(test)]
#[path = "server_tests.rs"]
mod tests;
