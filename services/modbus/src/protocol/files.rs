//! File records (functions 20 and 21) and FIFO queues (24): V1.1b3 clauses 6.14, 6.15 and 6.18.
//!
//! One request carries several groups. They stay the bytes of the PDU and are walked where they lie; a PDU whose
//! groups do not fit together is refused as a whole before anything is read or written.

use super::wire::u16_at;

/// The only reference type (clauses 6.14 and 6.15).
pub const REFERENCE_TYPE: u8 = 6;
/// Bytes of one group of a read request.
pub const READ_GROUP: usize = 7;
/// Most bytes of the groups of a read request, and of its response (clause 6.14: F5h).
pub const MAX_READ_BYTES: usize = 0xF5;
/// Most bytes of the groups of a write request (clause 6.15: FBh).
pub const MAX_WRITE_BYTES: usize = 0xFB;
/// Highest record number (clause 6.14: 9999).
pub const MAX_RECORD: u16 = 9999;
/// Most registers of a FIFO queue (clause 6.18).
pub const MAX_FIFO: usize = 31;

/// One group of a read request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadGroup {
    /// Must be [`REFERENCE_TYPE`]; else exception 02.
    pub reference: u8,
    /// 1-65535.
    pub file: u16,
    /// First record, 0-9999. A record is one register.
    pub record: u16,
    /// Records.
    pub count: u16,
}

/// One group of a write request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WriteGroup<'a> {
    /// Must be [`REFERENCE_TYPE`]; else exception 02.
    pub reference: u8,
    pub file: u16,
    pub record: u16,
    /// The wire's big-endian registers, at least one.
    pub values: &'a [u8],
}

impl WriteGroup<'_> {
    /// Records written.
    pub fn count(&self) -> u16 {
        (self.values.len() / 2) as u16
    }
}

/// The groups of a read request; ends early where bytes do not make a whole group.
pub fn read_groups(bytes: &[u8]) -> impl Iterator<Item = ReadGroup> + '_ {
    bytes.chunks_exact(READ_GROUP).filter_map(|group| {
        Some(ReadGroup {
            reference: *group.first()?,
            file: u16_at(group, 1)?,
            record: u16_at(group, 3)?,
            count: u16_at(group, 5)?,
        })
    })
}

/// The groups of a write request; ends early where bytes do not make a whole group.
pub fn write_groups(bytes: &[u8]) -> WriteGroups<'_> {
    WriteGroups { rest: bytes }
}

/// See [`write_groups`].
pub struct WriteGroups<'a> {
    rest: &'a [u8],
}

impl<'a> Iterator for WriteGroups<'a> {
    type Item = WriteGroup<'a>;

    fn next(&mut self) -> Option<WriteGroup<'a>> {
        let rest = self.rest;
        let len = usize::from(u16_at(rest, 5)?) * 2;
        let values = rest.get(READ_GROUP..READ_GROUP + len).filter(|values| !values.is_empty())?;
        self.rest = rest.get(READ_GROUP + len..)?;
        Some(WriteGroup {
            reference: *rest.first()?,
            file: u16_at(rest, 1)?,
            record: u16_at(rest, 3)?,
            values,
        })
    }
}

/// Appends a group to the groups of a read request, for clients. `false` when `out` is full.
#[must_use]
pub fn put_read_group(file: u16, record: u16, count: u16, out: &mut Vec<u8>) -> bool {
    out.push(REFERENCE_TYPE);
    for word in [file, record, count] {
        out.extend_from_slice(&word.to_be_bytes());
    }
    is_read_request(out)
}

/// Appends a group to the groups of a write request, for clients; `values` are big-endian registers. `false` when
/// it does not fit.
#[must_use]
pub fn put_write_group(file: u16, record: u16, values: &[u8], out: &mut Vec<u8>) -> bool {
    out.push(REFERENCE_TYPE);
    for word in [file, record, (values.len() / 2) as u16] {
        out.extend_from_slice(&word.to_be_bytes());
    }
    out.extend_from_slice(values);
    is_write_request(out)
}

/// Whether these are groups of a legal read request: whole, at least one record each, and an answer that fits.
pub(super) fn is_read_request(groups: &[u8]) -> bool {
    let answer: usize = read_groups(groups).map(|group| 2 + usize::from(group.count) * 2).sum();
    (READ_GROUP..=MAX_READ_BYTES).contains(&groups.len())
        && groups.len().is_multiple_of(READ_GROUP)
        && read_groups(groups).all(|group| group.count > 0)
        && answer <= MAX_READ_BYTES
}

/// Whether these are groups of a legal write request: whole, at least one record each.
pub(super) fn is_write_request(groups: &[u8]) -> bool {
    let whole: usize = write_groups(groups).map(|group| READ_GROUP + group.values.len()).sum();
    (READ_GROUP + 2..=MAX_WRITE_BYTES).contains(&groups.len()) && whole == groups.len()
}

/// The registers of each group of a response to function 20; ends early where bytes do not make a whole group.
pub fn answered_groups(bytes: &[u8]) -> AnsweredGroups<'_> {
    AnsweredGroups { rest: bytes }
}

/// See [`answered_groups`].
pub struct AnsweredGroups<'a> {
    rest: &'a [u8],
}

impl<'a> Iterator for AnsweredGroups<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        let (&len, rest) = self.rest.split_first()?;
        let group = rest.get(..usize::from(len))?;
        self.rest = rest.get(usize::from(len)..)?;
        let (&reference, values) = group.split_first()?;
        (reference == REFERENCE_TYPE && !values.is_empty() && values.len().is_multiple_of(2))
            .then_some(values)
    }
}

/// Whether these are groups of a response to function 20.
pub(super) fn is_read_response(groups: &[u8]) -> bool {
    let whole: usize = answered_groups(groups).map(|values| 2 + values.len()).sum();
    (4..=MAX_READ_BYTES).contains(&groups.len()) && whole == groups.len()
}

/// Whether the groups of a response have the lengths asked for.
pub(super) fn fits_request(asked: &[u8], answered: &[u8]) -> bool {
    is_read_response(answered)
        && read_groups(asked)
            .map(|group| usize::from(group.count) * 2)
            .eq(answered_groups(answered).map(<[u8]>::len))
}
