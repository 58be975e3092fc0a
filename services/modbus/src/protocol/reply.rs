//! Responses: written by servers, read by clients.

use super::pdu::{
    COIL_ON, EXCEPTION_BIT, EncodeError, MAX_PDU, MAX_READ_BITS, MAX_READ_WORDS, MAX_WRITE_BITS,
    MAX_WRITE_WORDS, Request, bytes_for_bits, function,
};
use super::wire::{Writer, u16_at};
use super::{diagnostics, files, identification};

/// Most events of a log (V1.1b3 clause 6.10).
pub const MAX_EVENTS: usize = 64;

/// A response. Coil values are packed low bit first, register values are the wire's big-endian bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Response<'a> {
    /// Function 1; bits beyond the quantity asked for are zero.
    ReadCoils(&'a [u8]),
    /// Function 2; bits beyond the quantity asked for are zero.
    ReadDiscreteInputs(&'a [u8]),
    /// Function 3.
    ReadHoldingRegisters(&'a [u8]),
    /// Function 4.
    ReadInputRegisters(&'a [u8]),
    /// Function 5, echo of the request.
    WriteSingleCoil { address: u16, on: bool },
    /// Function 6, echo of the request.
    WriteSingleRegister { address: u16, value: u16 },
    /// Function 15.
    WriteMultipleCoils { address: u16, quantity: u16 },
    /// Function 16.
    WriteMultipleRegisters { address: u16, quantity: u16 },
    /// Function 22, echo of the request.
    MaskWriteRegister { address: u16, and_mask: u16, or_mask: u16 },
    /// Function 23, the registers read.
    ReadWriteMultipleRegisters(&'a [u8]),
    /// Function 7, eight bits.
    ReadExceptionStatus(u8),
    /// Function 8. To sub-function 4 there is no response.
    Diagnostics { sub_function: u16, data: &'a [u8] },
    /// Function 11: status FFFFh = busy with an earlier program command.
    GetCommEventCounter { status: u16, events: u16 },
    /// Function 12: the newest event first, at most [`MAX_EVENTS`].
    GetCommEventLog { status: u16, events: u16, messages: u16, log: &'a [u8] },
    /// Function 17, device specific: id, run indicator (00 or FF), more.
    ReportServerId(&'a [u8]),
    /// Function 20; the groups as [`files::answered_groups`] walks them.
    ReadFileRecord { groups: &'a [u8] },
    /// Function 21, echo of the request.
    WriteFileRecord { groups: &'a [u8] },
    /// Function 24: the registers queued, at most [`files::MAX_FIFO`].
    ReadFifoQueue(&'a [u8]),
    /// Function 43/14; the objects as [`identification::objects`] walks them. `next` is the object to ask for
    /// when `more` follow.
    ReadDeviceIdentification { code: u8, conformity: u8, more: bool, next: u8, objects: &'a [u8] },
    /// Function 43/13: what follows the MEI type.
    CanopenGeneralReference { data: &'a [u8] },
    /// Any function: `function` without the top bit, `code` as received (it need not be a known one).
    Exception { function: u8, code: u8 },
}

/// A response that does not belong to its request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ResponseError {
    /// No function code at all.
    #[error("the response is empty")]
    Empty,
    /// The function code is neither the request's nor its exception's.
    #[error("the response is to function {got} but function {expected} was asked; drop the connection")]
    Function { expected: u8, got: u8 },
    /// Too short, too long, or a byte count that does not fit what was asked.
    #[error("the response to function {function} has the wrong length or byte count; drop the connection")]
    Length { function: u8 },
    /// An echo that differs from the request.
    #[error("the response to function {function} repeats another address, quantity or value than asked")]
    Echo { function: u8 },
}

impl Response<'_> {
    /// Function code on the wire, exception bit included.
    pub fn function(&self) -> u8 {
        match self {
            Self::ReadCoils(_) => function::READ_COILS,
            Self::ReadDiscreteInputs(_) => function::READ_DISCRETE_INPUTS,
            Self::ReadHoldingRegisters(_) => function::READ_HOLDING_REGISTERS,
            Self::ReadInputRegisters(_) => function::READ_INPUT_REGISTERS,
            Self::WriteSingleCoil { .. } => function::WRITE_SINGLE_COIL,
            Self::WriteSingleRegister { .. } => function::WRITE_SINGLE_REGISTER,
            Self::WriteMultipleCoils { .. } => function::WRITE_MULTIPLE_COILS,
            Self::WriteMultipleRegisters { .. } => function::WRITE_MULTIPLE_REGISTERS,
            Self::MaskWriteRegister { .. } => function::MASK_WRITE_REGISTER,
            Self::ReadWriteMultipleRegisters(_) => function::READ_WRITE_MULTIPLE_REGISTERS,
            Self::ReadExceptionStatus(_) => function::READ_EXCEPTION_STATUS,
            Self::Diagnostics { .. } => function::DIAGNOSTICS,
            Self::GetCommEventCounter { .. } => function::GET_COMM_EVENT_COUNTER,
            Self::GetCommEventLog { .. } => function::GET_COMM_EVENT_LOG,
            Self::ReportServerId(_) => function::REPORT_SERVER_ID,
            Self::ReadFileRecord { .. } => function::READ_FILE_RECORD,
            Self::WriteFileRecord { .. } => function::WRITE_FILE_RECORD,
            Self::ReadFifoQueue(_) => function::READ_FIFO_QUEUE,
            Self::ReadDeviceIdentification { .. } | Self::CanopenGeneralReference { .. } => {
                function::ENCAPSULATED_INTERFACE
            }
            Self::Exception { function, .. } => function | EXCEPTION_BIT,
        }
    }

    fn is_legal(&self) -> bool {
        match *self {
            Self::ReadCoils(bytes) | Self::ReadDiscreteInputs(bytes) => {
                (1..=bytes_for_bits(MAX_READ_BITS)).contains(&bytes.len())
            }
            Self::ReadHoldingRegisters(bytes)
            | Self::ReadInputRegisters(bytes)
            | Self::ReadWriteMultipleRegisters(bytes) => {
                bytes.len().is_multiple_of(2)
                    && (1..=usize::from(MAX_READ_WORDS)).contains(&(bytes.len() / 2))
            }
            Self::WriteMultipleCoils { quantity, .. } => (1..=MAX_WRITE_BITS).contains(&quantity),
            Self::WriteMultipleRegisters { quantity, .. } => (1..=MAX_WRITE_WORDS).contains(&quantity),
            Self::WriteSingleCoil { .. }
            | Self::WriteSingleRegister { .. }
            | Self::MaskWriteRegister { .. }
            | Self::ReadExceptionStatus(_)
            | Self::GetCommEventCounter { .. }
            | Self::Exception { .. } => true,
            Self::Diagnostics { sub_function, data } => {
                diagnostics::sub::ALL.contains(&sub_function) && diagnostics::is_words(data)
            }
            Self::GetCommEventLog { log, .. } => log.len() <= MAX_EVENTS,
            Self::ReportServerId(data) => data.len() <= MAX_PDU - 2,
            Self::ReadFileRecord { groups } => files::is_read_response(groups),
            Self::WriteFileRecord { groups } => files::is_write_request(groups),
            Self::ReadFifoQueue(values) => {
                values.len().is_multiple_of(2) && values.len() / 2 <= files::MAX_FIFO
            }
            Self::ReadDeviceIdentification { objects, .. } => identification::count(objects).is_some(),
            Self::CanopenGeneralReference { data } => data.len() <= MAX_PDU - 2,
        }
    }
}

/// Writes a response PDU into `out` ([`super::pdu::MAX_PDU`] bytes always suffice) and returns its length.
pub fn encode_response(response: &Response<'_>, out: &mut [u8]) -> Result<usize, EncodeError> {
    if !response.is_legal() {
        return Err(EncodeError::Limits { function: response.function() });
    }
    let mut w = Writer::new(out);
    w.u8(response.function())?;
    match *response {
        Response::ReadCoils(bytes)
        | Response::ReadDiscreteInputs(bytes)
        | Response::ReadHoldingRegisters(bytes)
        | Response::ReadInputRegisters(bytes)
        | Response::ReadWriteMultipleRegisters(bytes) => {
            w.u8(bytes.len() as u8)?;
            w.bytes(bytes)?;
        }
        Response::WriteSingleCoil { address, on } => {
            w.u16(address)?;
            w.u16(if on { COIL_ON } else { 0 })?;
        }
        Response::WriteSingleRegister { address, value } => {
            w.u16(address)?;
            w.u16(value)?;
        }
        Response::WriteMultipleCoils { address, quantity }
        | Response::WriteMultipleRegisters { address, quantity } => {
            w.u16(address)?;
            w.u16(quantity)?;
        }
        Response::MaskWriteRegister { address, and_mask, or_mask } => {
            w.u16(address)?;
            w.u16(and_mask)?;
            w.u16(or_mask)?;
        }
        Response::ReadExceptionStatus(status) => w.u8(status)?,
        Response::Diagnostics { sub_function, data } => {
            w.u16(sub_function)?;
            w.bytes(data)?;
        }
        Response::GetCommEventCounter { status, events } => {
            w.u16(status)?;
            w.u16(events)?;
        }
        Response::GetCommEventLog { status, events, messages, log } => {
            w.u8((6 + log.len()) as u8)?;
            w.u16(status)?;
            w.u16(events)?;
            w.u16(messages)?;
            w.bytes(log)?;
        }
        Response::ReportServerId(bytes)
        | Response::ReadFileRecord { groups: bytes }
        | Response::WriteFileRecord { groups: bytes } => {
            w.u8(bytes.len() as u8)?;
            w.bytes(bytes)?;
        }
        Response::ReadFifoQueue(values) => {
            w.u16((2 + values.len()) as u16)?;
            w.u16((values.len() / 2) as u16)?;
            w.bytes(values)?;
        }
        Response::ReadDeviceIdentification { code, conformity, more, next, objects } => {
            let more = if more { 0xFF } else { 0 };
            let count = identification::count(objects).unwrap_or(0);
            w.bytes(&[identification::MEI_DEVICE_IDENTIFICATION, code, conformity, more, next, count])?;
            w.bytes(objects)?;
        }
        Response::CanopenGeneralReference { data } => {
            w.u8(identification::MEI_CANOPEN)?;
            w.bytes(data)?;
        }
        Response::Exception { code, .. } => w.u8(code)?,
    }
    Ok(w.len())
}

/// Reads the response PDU to `request`, function code first, and checks that it can be the answer to it.
pub fn decode_response<'a>(request: &Request<'_>, pdu: &'a [u8]) -> Result<Response<'a>, ResponseError> {
    let (&got, data) = pdu.split_first().ok_or(ResponseError::Empty)?;
    let asked = request.function();
    if got == asked | EXCEPTION_BIT {
        return match data {
            &[code] => Ok(Response::Exception { function: asked, code }),
            _ => Err(ResponseError::Length { function: asked }),
        };
    }
    if got != asked {
        return Err(ResponseError::Function { expected: asked, got });
    }
    // No transport carries more; found by the fuzzer through function 17, whose byte count alone allows 255.
    if pdu.len() > MAX_PDU {
        return Err(ResponseError::Length { function: asked });
    }
    let response = match *request {
        Request::ReadCoils { quantity, .. } => {
            Response::ReadCoils(counted(asked, data, bytes_for_bits(quantity))?)
        }
        Request::ReadDiscreteInputs { quantity, .. } => {
            Response::ReadDiscreteInputs(counted(asked, data, bytes_for_bits(quantity))?)
        }
        Request::ReadHoldingRegisters { quantity, .. } => {
            Response::ReadHoldingRegisters(counted(asked, data, usize::from(quantity) * 2)?)
        }
        Request::ReadInputRegisters { quantity, .. } => {
            Response::ReadInputRegisters(counted(asked, data, usize::from(quantity) * 2)?)
        }
        Request::ReadWriteMultipleRegisters { read_quantity, .. } => {
            Response::ReadWriteMultipleRegisters(counted(asked, data, usize::from(read_quantity) * 2)?)
        }
        Request::WriteSingleCoil { address, on } => {
            echo(asked, data, &[address, if on { COIL_ON } else { 0 }])?;
            Response::WriteSingleCoil { address, on }
        }
        Request::WriteSingleRegister { address, value } => {
            echo(asked, data, &[address, value])?;
            Response::WriteSingleRegister { address, value }
        }
        Request::WriteMultipleCoils { address, quantity, .. } => {
            echo(asked, data, &[address, quantity])?;
            Response::WriteMultipleCoils { address, quantity }
        }
        Request::WriteMultipleRegisters { address, values } => {
            let quantity = (values.len() / 2) as u16;
            echo(asked, data, &[address, quantity])?;
            Response::WriteMultipleRegisters { address, quantity }
        }
        Request::MaskWriteRegister { address, and_mask, or_mask } => {
            echo(asked, data, &[address, and_mask, or_mask])?;
            Response::MaskWriteRegister { address, and_mask, or_mask }
        }
        _ => decode_special(request, data).ok_or(ResponseError::Length { function: asked })??,
    };
    Ok(response)
}

/// Responses to the functions beyond tables. `None`: the length does not fit.
fn decode_special<'a>(request: &Request<'_>, data: &'a [u8]) -> Option<Result<Response<'a>, ResponseError>> {
    let function = request.function();
    let all =
        |at: usize| data.get(at..).filter(|rest| data.get(at - 1) == u8::try_from(rest.len()).ok().as_ref());
    let response = match *request {
        Request::ReadExceptionStatus => match data {
            &[status] => Response::ReadExceptionStatus(status),
            _ => return None,
        },
        Request::Diagnostics { sub_function, data: asked } => {
            let answered = data.get(2..).filter(|answered| diagnostics::is_words(answered))?;
            let repeats = matches!(sub_function, diagnostics::sub::RETURN_QUERY_DATA);
            if u16_at(data, 0) != Some(sub_function) || (repeats && answered != asked) {
                return Some(Err(ResponseError::Echo { function }));
            }
            Response::Diagnostics { sub_function, data: answered }
        }
        Request::GetCommEventCounter => {
            (data.len() == 4).then_some(())?;
            Response::GetCommEventCounter { status: u16_at(data, 0)?, events: u16_at(data, 2)? }
        }
        Request::GetCommEventLog => {
            let body = all(1)?;
            Response::GetCommEventLog {
                status: u16_at(body, 0)?,
                events: u16_at(body, 2)?,
                messages: u16_at(body, 4)?,
                log: body.get(6..).filter(|log| log.len() <= MAX_EVENTS)?,
            }
        }
        Request::ReportServerId => Response::ReportServerId(all(1)?),
        Request::ReadFileRecord { groups } => {
            let answered = all(1)?;
            files::fits_request(groups, answered).then_some(Response::ReadFileRecord { groups: answered })?
        }
        Request::WriteFileRecord { groups } => {
            let answered = all(1)?;
            if answered != groups {
                return Some(Err(ResponseError::Echo { function }));
            }
            Response::WriteFileRecord { groups: answered }
        }
        Request::ReadFifoQueue { .. } => {
            let values = data.get(4..)?;
            let (bytes, count) = (usize::from(u16_at(data, 0)?), usize::from(u16_at(data, 2)?));
            let fits = bytes == values.len() + 2 && count * 2 == values.len() && count <= files::MAX_FIFO;
            fits.then_some(Response::ReadFifoQueue(values))?
        }
        Request::ReadDeviceIdentification { code, .. } => {
            let &[mei, answered, conformity, more, next, count, ref objects @ ..] = data else { return None };
            let kind = mei == identification::MEI_DEVICE_IDENTIFICATION && answered == code;
            if !kind || !matches!(more, 0 | 0xFF) {
                return Some(Err(ResponseError::Echo { function }));
            }
            (identification::count(objects)? == count).then_some(())?;
            Response::ReadDeviceIdentification { code, conformity, more: more != 0, next, objects }
        }
        Request::CanopenGeneralReference { .. } => match data {
            [identification::MEI_CANOPEN, data @ ..] if data.len() <= MAX_PDU - 2 => {
                Response::CanopenGeneralReference { data }
            }
            _ => return None,
        },
        _ => return None,
    };
    Some(Ok(response))
}

fn counted(function: u8, data: &[u8], expected: usize) -> Result<&[u8], ResponseError> {
    match data.split_first() {
        Some((&count, bytes)) if usize::from(count) == expected && bytes.len() == expected => Ok(bytes),
        _ => Err(ResponseError::Length { function }),
    }
}

fn echo(function: u8, data: &[u8], words: &[u16]) -> Result<(), ResponseError> {
    if data.len() != words.len() * 2 {
        return Err(ResponseError::Length { function });
    }
    let same = words.iter().enumerate().all(|(i, &word)| u16_at(data, i * 2) == Some(word));
    if same { Ok(()) } else { Err(ResponseError::Echo { function }) }
}
