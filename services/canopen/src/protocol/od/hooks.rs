//! Where the owner of an object dictionary takes part in the network's reads and writes.

use super::{Abort, ObjectDictionary};

/// What becomes of a value that [`Hooks::before_write`] agreed to.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Accept {
    /// The dictionary stores it.
    Store,
    /// The owner took it (a command such as "save" in 1010h, a list that was cleared): the value stays.
    Taken,
}

/// The owner's part in every read and write by the network (SDO). Called after the dictionary's own checks.
///
/// Nothing in here may block or allocate: it runs between a frame in and a frame out.
pub trait Hooks {
    /// Before the network reads: refresh the value, or refuse.
    fn before_read(&mut self, od: &mut ObjectDictionary, index: u16, sub: u8) -> Result<(), Abort> {
        let _ = (od, index, sub);
        Ok(())
    }
    /// Before the network's value is stored: agree, take it, or refuse. `data` has a valid length and lies
    /// within the limits.
    fn before_write(
        &mut self,
        od: &mut ObjectDictionary,
        index: u16,
        sub: u8,
        data: &[u8],
    ) -> Result<Accept, Abort> {
        let _ = (od, index, sub, data);
        Ok(Accept::Store)
    }
    /// After a write that was agreed to.
    fn after_write(&mut self, od: &mut ObjectDictionary, index: u16, sub: u8) {
        let _ = (od, index, sub);
    }
}

/// No owner takes part.
#[derive(Clone, Copy, Default, Debug)]
pub struct NoHooks;

impl Hooks for NoHooks {}
