//! Connections to servers: Modbus TCP by tokio-modbus, and RTU frames on a connection.
//!
//! A link is a task with two queues: orders in, reports out. It connects when it is first ordered to send, never
//! repeats anything and knows no timeout but that of connecting; when to give up on an answer is the line's business,
//! which then orders the connection dropped. A connection that the server has ended while nothing was asked (most do so
//! after a while) is made anew before the next request, which would be lost on it.

use super::plan::Target;
use crate::protocol::client_fit::{Length, length};
use crate::protocol::pdu::{COIL_ON, EXCEPTION_BIT, MAX_PDU};
use crate::protocol::rtu;
use rustix::net::{RecvFlags, recv};
use std::net::SocketAddr;
use std::os::fd::{AsFd, OwnedFd};
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio_modbus::client::{Client, Context, tcp::attach_slave};
use tokio_modbus::prelude::{ProtocolError, Request, Response, Slave, SlaveContext};

/// An order to a link.
#[derive(Debug)]
pub enum Order {
    /// `seq` comes back with every report about it, so that a report of an earlier one is told apart.
    Send { seq: u64, unit: u8, pdu: Vec<u8> },
    /// Drop the connection, and with it what is under way.
    Drop,
}

/// What a link tells.
#[derive(Debug, PartialEq, Eq)]
pub enum Report {
    /// The connection stands; `anew`: the server had ended the one before.
    Connected {
        anew: bool,
    },
    /// The request is on its way.
    Sent,
    Answer {
        unit: u8,
        pdu: Vec<u8>,
    },
    /// The connection cannot be made or broke.
    Failed(String),
    /// Bytes that are no frame.
    Garbage,
}

/// Number of the line, of the order, and what happened.
pub type Reports = mpsc::UnboundedSender<(usize, u64, Report)>;

/// The orders' end of a link.
pub struct Link {
    orders: mpsc::UnboundedSender<Order>,
    seq: u64,
}

impl Link {
    /// Starts the task; its reports come with the number `line`.
    pub fn start(line: usize, target: &Target, connect_timeout: Duration, reports: Reports) -> Option<Self> {
        // One request is in flight, so a queue never holds more than an order to send and one to drop.
        let (orders, inbox) = mpsc::unbounded_channel();
        let task = Task { line, seq: 0, orders: inbox, next: None, reports, connect_timeout, ended: false };
        match *target {
            Target::Tcp(address) => tokio::task::spawn_local(task.tcp(address)),
            Target::RtuOverTcp(address) => tokio::task::spawn_local(task.rtu(address)),
            Target::Serial { .. } => return None,
        };
        Some(Self { orders, seq: 0 })
    }

    pub fn send(&mut self, unit: u8, pdu: &[u8]) {
        self.seq += 1;
        let _ = self.orders.send(Order::Send { seq: self.seq, unit, pdu: pdu.to_vec() });
    }

    /// Whether a report is about the last request sent.
    pub fn is_current(&self, seq: u64) -> bool {
        self.seq == seq
    }

    pub fn reset(&self) {
        let _ = self.orders.send(Order::Drop);
    }
}

struct Task {
    line: usize,
    seq: u64,
    orders: mpsc::UnboundedReceiver<Order>,
    /// An order to send that came while another one was under way.
    next: Option<Order>,
    reports: Reports,
    connect_timeout: Duration,
    /// The server has ended the connection that stood last.
    ended: bool,
}

/// How a connection that is not used at the moment is.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Idle {
    Well,
    /// Something came that nobody asked for.
    Unasked,
    /// The other side has ended it.
    Ended,
}

fn idle(stream: impl AsFd) -> Idle {
    match recv(stream, &mut [0_u8; 1], RecvFlags::PEEK | RecvFlags::DONTWAIT) {
        Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => Idle::Well,
        Ok((1.., _)) => Idle::Unasked,
        Ok(_) | Err(_) => Idle::Ended,
    }
}

impl Task {
    fn tell(&self, report: Report) {
        let _ = self.reports.send((self.line, self.seq, report));
    }

    async fn order(&mut self) -> Option<Order> {
        match self.next.take() {
            Some(order) => Some(order),
            None => self.orders.recv().await,
        }
    }

    /// An order came while another one was under way, which is given up.
    fn interrupted(&mut self, order: Option<Order>) {
        self.next = order.filter(|order| matches!(order, Order::Send { .. }));
    }

    /// Connects; `None`: told why not, or ordered to drop it.
    async fn connect(&mut self, address: SocketAddr) -> Option<TcpStream> {
        let attempt = async {
            let stream = TcpStream::connect(address).await?;
            // Without it Nagle's algorithm and delayed acknowledgement cost 40 ms a request.
            stream.set_nodelay(true)?;
            Ok::<_, std::io::Error>(stream)
        };
        let connected = tokio::select! {
            connected = tokio::time::timeout(self.connect_timeout, attempt) => connected,
            order = self.orders.recv() => {
                self.interrupted(order);
                return None;
            }
        };
        match connected {
            Ok(Ok(stream)) => {
                let anew = std::mem::take(&mut self.ended);
                self.tell(Report::Connected { anew });
                Some(stream)
            }
            Ok(Err(e)) => {
                self.tell(Report::Failed(format!("connecting to {address}: {e}")));
                None
            }
            Err(_) => {
                let limit = self.connect_timeout;
                self.tell(Report::Failed(format!(
                    "connecting to {address}: nobody answered within {limit:?}"
                )));
                None
            }
        }
    }

    async fn tcp(mut self, address: SocketAddr) {
        // With a second descriptor of the connection: tokio-modbus does not show its own.
        let mut connection: Option<(Context, OwnedFd)> = None;
        while let Some(order) = self.order().await {
            let Order::Send { seq, unit, pdu } = order else {
                connection = None;
                continue;
            };
            self.seq = seq;
            if let Some((_, fd)) = &connection {
                let idle = idle(fd);
                self.ended |= idle == Idle::Ended;
                if idle != Idle::Well {
                    connection = None;
                }
            }
            if connection.is_none() {
                let Some(stream) = self.connect(address).await else { continue };
                match stream.as_fd().try_clone_to_owned() {
                    Ok(fd) => connection = Some((attach_slave(stream, Slave(unit)), fd)),
                    Err(e) => {
                        self.tell(Report::Failed(format!("{address}: {e}")));
                        continue;
                    }
                }
            }
            let Some((open, _)) = &mut connection else { continue };
            open.set_slave(Slave(unit));
            let Some((&function, data)) = pdu.split_first() else { continue };
            self.tell(Report::Sent);
            let answer = tokio::select! {
                answer = open.call(Request::Custom(function, data.into())) => answer,
                // Ordered to drop it, or the service ends.
                order = self.orders.recv() => {
                    self.interrupted(order);
                    connection = None;
                    continue;
                }
            };
            match answer {
                Ok(Ok(response)) => self.tell(Report::Answer { unit, pdu: response_pdu(&response) }),
                Ok(Err(exception)) => {
                    let code = u8::from(exception);
                    self.tell(Report::Answer { unit, pdu: vec![function | EXCEPTION_BIT, code] });
                }
                // Requests go out as bytes ("custom"), answers come back by their meaning, which tokio-modbus takes
                // for another function. Whether it is, the line sees: it compares the bytes.
                Err(tokio_modbus::Error::Protocol(ProtocolError::FunctionCodeMismatch {
                    result, ..
                })) => {
                    let pdu = match result {
                        Ok(response) => response_pdu(&response),
                        Err(e) => vec![e.function.value() | EXCEPTION_BIT, u8::from(e.exception)],
                    };
                    self.tell(Report::Answer { unit, pdu });
                }
                Err(e) => {
                    let why = in_words(&e, connection.as_ref().map_or(Idle::Well, |(_, fd)| idle(fd)));
                    connection = None;
                    self.ended |= matches!(e, tokio_modbus::Error::Transport(_));
                    self.tell(Report::Failed(format!("{address}: {why}")));
                }
            }
        }
    }

    async fn rtu(mut self, address: SocketAddr) {
        let mut connection: Option<TcpStream> = None;
        let mut buffer = Vec::with_capacity(2 * rtu::MAX_ADU);
        while let Some(order) = self.order().await {
            let Order::Send { seq, unit, pdu } = order else {
                connection = None;
                continue;
            };
            self.seq = seq;
            if let Some(stream) = &connection {
                // What came unasked is no answer.
                let mut waste = [0_u8; 512];
                while matches!(recv(stream, &mut waste, RecvFlags::DONTWAIT), Ok((1.., _))) {}
                if idle(stream) == Idle::Ended {
                    self.ended = true;
                    connection = None;
                }
            }
            if connection.is_none() {
                connection = self.connect(address).await;
            }
            let Some(stream) = &mut connection else { continue };
            let mut frame = [0; rtu::MAX_ADU];
            let len = rtu::encode(unit, &pdu, &mut frame);
            buffer.clear();
            let answered = match stream.write_all(&frame[..len]).await {
                Ok(()) => {
                    self.tell(Report::Sent);
                    // A broadcast has no answer; the line orders nothing while it pauses.
                    if unit == 0 {
                        continue;
                    }
                    self.answer(stream, unit, &pdu, &mut buffer).await
                }
                Err(e) => Err(Some(e)),
            };
            if let Err(why) = answered {
                connection = None;
                if let Some(e) = why {
                    self.ended = true;
                    self.tell(Report::Failed(format!("{address}: {e}")));
                }
            }
        }
    }

    /// Reads until the frame awaited is whole. `Err(None)`: ordered to drop the connection.
    async fn answer(
        &mut self,
        stream: &mut TcpStream,
        unit: u8,
        request: &[u8],
        buffer: &mut Vec<u8>,
    ) -> Result<(), Option<std::io::Error>> {
        let mut some = [0; rtu::MAX_ADU];
        loop {
            let read = tokio::select! {
                read = stream.read(&mut some) => read,
                order = self.orders.recv() => {
                    self.interrupted(order);
                    return Err(None);
                }
            };
            match read {
                Ok(0) => return Err(Some(std::io::Error::other(CLOSED))),
                Ok(n) => buffer.extend_from_slice(&some[..n]),
                Err(e) => return Err(Some(e)),
            }
            match find_answer(unit, request, buffer) {
                Found::Frame(pdu) => {
                    self.tell(Report::Answer { unit, pdu });
                    return Ok(());
                }
                Found::More => {}
                Found::Garbage => {
                    self.tell(Report::Garbage);
                    buffer.clear();
                }
            }
        }
    }
}

enum Found {
    Frame(Vec<u8>),
    More,
    Garbage,
}

/// Looks for the answer to a request in a stream of RTU frames, at any place in it: converters pass noise on.
fn find_answer(unit: u8, request: &[u8], bytes: &[u8]) -> Found {
    for start in 0..bytes.len() {
        let rest = &bytes[start..];
        if rest[0] != unit {
            continue;
        }
        let end = match length(request, &rest[1..]) {
            Length::Exactly(len) => len + 3,
            Length::AtLeast(_) => return Found::More,
            Length::Unknown => rest.len(),
        };
        let Some(frame) = rest.get(..end) else {
            // It may be the beginning of the answer, unless another one follows further on.
            return Found::More;
        };
        if let Ok((_, pdu)) = rtu::decode(frame) {
            return Found::Frame(pdu.to_vec());
        }
    }
    if bytes.len() > 2 * rtu::MAX_ADU { Found::Garbage } else { Found::More }
}

/// tokio-modbus decodes answers to what programs like; back to the bytes they were.
fn response_pdu(response: &Response) -> Vec<u8> {
    let mut pdu = vec![response.function_code().value()];
    let bits = |pdu: &mut Vec<u8>, values: &[bool]| {
        pdu.push(values.len().div_ceil(8) as u8);
        for eight in values.chunks(8) {
            pdu.push(eight.iter().enumerate().fold(0, |byte, (i, on)| byte | u8::from(*on) << i));
        }
    };
    let words = |pdu: &mut Vec<u8>, values: &[u16]| {
        pdu.push((values.len() * 2) as u8);
        pdu.extend(values.iter().flat_map(|word| word.to_be_bytes()));
    };
    let two = |pdu: &mut Vec<u8>, a: u16, b: u16| {
        pdu.extend(a.to_be_bytes());
        pdu.extend(b.to_be_bytes());
    };
    match response {
        Response::ReadCoils(values) | Response::ReadDiscreteInputs(values) => bits(&mut pdu, values),
        Response::ReadInputRegisters(values)
        | Response::ReadHoldingRegisters(values)
        | Response::ReadWriteMultipleRegisters(values) => words(&mut pdu, values),
        Response::WriteSingleCoil(address, on) => two(&mut pdu, *address, if *on { COIL_ON } else { 0 }),
        Response::WriteMultipleCoils(address, n)
        | Response::WriteSingleRegister(address, n)
        | Response::WriteMultipleRegisters(address, n) => two(&mut pdu, *address, *n),
        Response::MaskWriteRegister(address, and, or) => {
            two(&mut pdu, *address, *and);
            pdu.extend(or.to_be_bytes());
        }
        Response::ReportServerId(id, running, rest) => {
            pdu.extend([rest.len() as u8 + 2, *id, if *running { 0xFF } else { 0 }]);
            pdu.extend(rest);
        }
        Response::ReadDeviceIdentification(found) => {
            pdu.extend([14, found.read_code.value(), found.conformity_level.value()]);
            pdu.push(if found.more_follows { 0xFF } else { 0 });
            pdu.extend([found.next_object_id, found.device_id_objects.len() as u8]);
            for object in &found.device_id_objects {
                pdu.extend([object.id, object.value.len() as u8]);
                pdu.extend(&object.value);
            }
        }
        Response::Custom(_, data) => pdu.extend_from_slice(data),
    }
    pdu.truncate(MAX_PDU);
    pdu
}

const CLOSED: &str = "the other side closed the connection";

/// What went wrong, for people; tokio-modbus' own texts carry whole frames. At the end of a connection it makes an
/// error of whatever the system's last one was (EAGAIN most of the time), so the connection itself is asked.
fn in_words(error: &tokio_modbus::Error, connection: Idle) -> String {
    use std::io::ErrorKind::{BrokenPipe, ConnectionReset, UnexpectedEof, WouldBlock};
    match error {
        tokio_modbus::Error::Transport(e) if e.kind() == ConnectionReset => {
            "the other side broke the connection off".to_owned()
        }
        tokio_modbus::Error::Transport(e)
            if connection == Idle::Ended
                || e.raw_os_error() == Some(0)
                || matches!(e.kind(), BrokenPipe | UnexpectedEof | WouldBlock) =>
        {
            CLOSED.to_owned()
        }
        tokio_modbus::Error::Transport(e) => e.to_string(),
        tokio_modbus::Error::Protocol(_) => "the answer belongs to another request".to_owned(),
    }
}

#[cfg(test)]
#[path = "link_tests.rs"]
mod tests;
