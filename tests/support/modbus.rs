//! A Modbus TCP client of a few lines, for tests that must see every exception and every refused connection.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

pub struct Client {
    stream: TcpStream,
    transaction: u16,
}

/// An answer: registers, or the exception code.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    Registers(Vec<u16>),
    Written,
    Exception(u8),
}

impl Client {
    pub fn connect(port: u16) -> io::Result<Self> {
        let stream = TcpStream::connect(("127.0.0.1", port))?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(Duration::from_secs(20)))?;
        Ok(Self { stream, transaction: 0 })
    }

    fn call(&mut self, pdu: &[u8]) -> io::Result<Vec<u8>> {
        self.transaction = self.transaction.wrapping_add(1);
        let mut request = Vec::new();
        request.extend_from_slice(&self.transaction.to_be_bytes());
        request.extend_from_slice(&[0, 0]);
        request.extend_from_slice(&(pdu.len() as u16 + 1).to_be_bytes());
        request.push(1);
        request.extend_from_slice(pdu);
        self.stream.write_all(&request)?;
        let mut head = [0u8; 7];
        self.stream.read_exact(&mut head)?;
        assert_eq!(head[..2], self.transaction.to_be_bytes(), "transaction id");
        let mut body = vec![0u8; usize::from(u16::from_be_bytes([head[4], head[5]])) - 1];
        self.stream.read_exact(&mut body)?;
        Ok(body)
    }

    pub fn read(&mut self, function: u8, address: u16, count: u16) -> io::Result<Answer> {
        let mut pdu = vec![function];
        pdu.extend_from_slice(&address.to_be_bytes());
        pdu.extend_from_slice(&count.to_be_bytes());
        let body = self.call(&pdu)?;
        if body[0] == function | 0x80 {
            return Ok(Answer::Exception(body[1]));
        }
        Ok(Answer::Registers(body[2..].chunks(2).map(|c| u16::from_be_bytes([c[0], c[1]])).collect()))
    }

    pub fn holding(&mut self, address: u16, count: u16) -> io::Result<Answer> {
        self.read(3, address, count)
    }

    pub fn write(&mut self, address: u16, value: u16) -> io::Result<Answer> {
        let mut pdu = vec![6];
        pdu.extend_from_slice(&address.to_be_bytes());
        pdu.extend_from_slice(&value.to_be_bytes());
        let body = self.call(&pdu)?;
        Ok(if body[0] & 0x80 != 0 { Answer::Exception(body[1]) } else { Answer::Written })
    }
}
