//! Concise DCF: the list of values a master writes to a node (CiA 302-3 V4.1, object 1F22h): number of entries as
//! UNSIGNED32, then for each entry index (UNSIGNED16), sub-index (UNSIGNED8), size (UNSIGNED32) and the data.

/// Most entries that are taken.
pub const MAX_ENTRIES: u32 = 100_000;

/// One value to write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Item<'a> {
    pub index: u16,
    pub sub: u8,
    pub data: &'a [u8],
}

/// What is wrong with a concise DCF; `at` counts bytes from its start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ConciseError {
    #[error("the concise DCF ends at byte {at} in the middle of an entry: make it anew")]
    Short { at: usize },
    #[error("the concise DCF says it has {0} entries, more than {MAX_ENTRIES}: it is damaged")]
    Count(u32),
    #[error("the concise DCF goes on behind its last entry, at byte {at}: it is damaged")]
    Long { at: usize },
}

/// Makes a concise DCF.
pub fn encode<'a>(items: impl IntoIterator<Item = Item<'a>>) -> Vec<u8> {
    let mut bytes = vec![0; 4];
    let mut count = 0u32;
    for item in items {
        count += 1;
        bytes.extend_from_slice(&item.index.to_le_bytes());
        bytes.push(item.sub);
        bytes.extend_from_slice(&(item.data.len() as u32).to_le_bytes());
        bytes.extend_from_slice(item.data);
    }
    bytes[..4].copy_from_slice(&count.to_le_bytes());
    bytes
}

/// Goes through the entries of a concise DCF without copying. Ends after the first error. Zero bytes are an empty
/// list, as an object 1F22h that was never written has them.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    left: u32,
    done: bool,
}

impl<'a> Reader<'a> {
    pub fn new(bytes: &'a [u8]) -> Result<Self, ConciseError> {
        let Some(count) = bytes.first_chunk::<4>() else {
            let empty = Self { bytes, at: 0, left: 0, done: true };
            return if bytes.is_empty() { Ok(empty) } else { Err(ConciseError::Short { at: bytes.len() }) };
        };
        let left = u32::from_le_bytes(*count);
        if left > MAX_ENTRIES {
            return Err(ConciseError::Count(left));
        }
        Ok(Self { bytes, at: 4, left, done: false })
    }
    fn take(&mut self, len: usize) -> Result<&'a [u8], ConciseError> {
        let end = self.at.checked_add(len).filter(|&end| end <= self.bytes.len());
        let end = end.ok_or(ConciseError::Short { at: self.bytes.len() })?;
        let taken = &self.bytes[self.at..end];
        self.at = end;
        Ok(taken)
    }
    fn item(&mut self) -> Result<Item<'a>, ConciseError> {
        let head = self.take(7)?;
        let size = super::unsigned_of(&head[3..7]) as usize;
        let data = self.take(size)?;
        Ok(Item { index: u16::from_le_bytes([head[0], head[1]]), sub: head[2], data })
    }
}

impl<'a> Iterator for Reader<'a> {
    type Item = Result<Item<'a>, ConciseError>;
    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        if self.left == 0 {
            self.done = true;
            return (self.at < self.bytes.len()).then_some(Err(ConciseError::Long { at: self.at }));
        }
        self.left -= 1;
        let item = self.item();
        self.done = item.is_err();
        Some(item)
    }
}

/// All entries of a concise DCF.
pub fn decode(bytes: &[u8]) -> Result<Vec<Item<'_>>, ConciseError> {
    Reader::new(bytes)?.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_list_as_masters_store_it() {
        let items = [
            Item { index: 0x1017, sub: 0, data: &[0xE8, 3] },
            Item { index: 0x1400, sub: 1, data: &[5, 2, 0, 0x80] },
        ];
        let bytes = encode(items);
        assert_eq!(
            bytes,
            [2, 0, 0, 0, 0x17, 0x10, 0, 2, 0, 0, 0, 0xE8, 3, 0, 0x14, 1, 4, 0, 0, 0, 5, 2, 0, 0x80]
        );
        assert_eq!(decode(&bytes).unwrap(), items);
        assert_eq!(decode(&[]), Ok(vec![]));
        assert_eq!(decode(&[0; 4]), Ok(vec![]));
        assert_eq!(decode(&bytes[..23]), Err(ConciseError::Short { at: 23 }));
        assert_eq!(decode(&[1]), Err(ConciseError::Short { at: 1 }));
        assert_eq!(decode(&[0; 5]), Err(ConciseError::Long { at: 4 }));
        assert_eq!(decode(&[0xFF; 9]), Err(ConciseError::Count(u32::MAX)));
    }

    proptest! {
        #[test]
        fn round_trip(list in prop::collection::vec((any::<u16>(), any::<u8>(), any::<Vec<u8>>()), 0..20)) {
            let items: Vec<_> =
                list.iter().map(|(index, sub, data)| Item { index: *index, sub: *sub, data }).collect();
            let bytes = encode(items.iter().copied());
            prop_assert_eq!(decode(&bytes), Ok(items));
        }
        #[test]
        fn any_bytes(mut bytes: Vec<u8>) {
            let _ = decode(&bytes);
            if bytes.len() > 4 {
                bytes[1..4].fill(0);
            }
            if let Ok(items) = decode(&bytes) {
                prop_assert!(bytes.is_empty() || encode(items) == bytes);
            }
        }
    }
}
