//! Wake-ups: every consumer has one event service, its inbox; the event id says which topic has news.

use crate::rail::{RailError, Svc, inbox_name, service_name};
use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::EventId;
use iceoryx2_bb_posix::file_descriptor::FileDescriptorBased;
use std::os::fd::{BorrowedFd, RawFd};

/// The receiving end.
pub struct Inbox {
    listener: Listener<Svc>,
    fd: RawFd,
}

impl Inbox {
    pub(crate) fn open(node: &Node<Svc>, service: &str) -> Result<Self, RailError> {
        let listener = node
            .service_builder(&service_name(&inbox_name(service))?)
            .event()
            .open()
            .map_err(|e| RailError::middleware(format!("opening inbox of '{service}'"), e))?
            .listener_builder()
            .create()
            .map_err(|e| RailError::middleware(format!("listening on inbox of '{service}'"), e))?;
        #[allow(unsafe_code)]
        // SAFETY: only the number is taken; the descriptor stays the listener's, which lives as long as `self`.
        let fd = unsafe { listener.file_descriptor().native_handle() };
        Ok(Self { listener, fd })
    }

    /// Readable while wake-ups wait. Level-triggered: [`Self::drain`] after each wake.
    pub fn fd(&self) -> BorrowedFd<'_> {
        #[allow(unsafe_code)]
        // SAFETY: the listener owns the descriptor and lives as long as the borrow.
        unsafe {
            BorrowedFd::borrow_raw(self.fd)
        }
    }

    /// Takes all waiting wake-ups and says which topics rang, as bits by event id 0-63 (higher ids ring bit 63).
    pub fn drain(&mut self) -> u64 {
        let mut rang = 0u64;
        let _ = self.listener.try_wait(|activation| rang |= 1 << activation.id.as_value().min(63));
        rang
    }
}

/// The ringing end to one inbox.
pub struct Bell {
    notifier: Notifier<Svc>,
}

impl Bell {
    pub(crate) fn open(node: &Node<Svc>, service: &str) -> Result<Self, RailError> {
        let notifier = node
            .service_builder(&service_name(&inbox_name(service))?)
            .event()
            .open()
            .map_err(|e| RailError::middleware(format!("opening inbox of '{service}'"), e))?
            .notifier_builder()
            .create()
            .map_err(|e| RailError::middleware(format!("ringing inbox of '{service}'"), e))?;
        Ok(Self { notifier })
    }

    /// Wakes the consumer. A dead one is no error: its successor reads the queue when it starts.
    pub fn ring(&self, event_id: u32) {
        let _ = self.notifier.notify_with_custom_event_id(EventId::new(event_id as usize));
    }
}
