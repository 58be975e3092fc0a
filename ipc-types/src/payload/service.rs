//! What services tell about themselves, and jobs they do for others.

use super::payload;

payload! {
    /// Heartbeat of a service on `<svc>/health`, sent at least every 100 ms by the thread that does the work.
    pub struct Health: "dinrail.Health/1", fixed, Ros1 {
        /// Process id.
        pub pid: u32,
        /// [`HealthState`].
        pub state: u32,
        /// Turns of the working loop since start.
        pub turns: u64,
    }
}

/// State in [`Health`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
pub enum HealthState {
    Starting = 0,
    Ready = 1,
    /// Works, but something is wrong: see the status.
    Degraded = 2,
    Stopping = 3,
}

impl HealthState {
    pub fn from_u32(n: u32) -> Self {
        match n {
            1 => Self::Ready,
            2 => Self::Degraded,
            3 => Self::Stopping,
            _ => Self::Starting,
        }
    }
}

payload! {
    /// Counters and peers of a service on `<svc>/status`, about once a second and on change. Tail: JSON object.
    pub struct Status: "dinrail.Status/1", tail, Json {
        /// Reserved, 0.
        pub reserved: u32,
        /// Bytes of the tail.
        pub n: u32,
    }
}

/// Bits of [`Event::flags`].
pub mod event_flag {
    /// Said before, when a recorder was not there to hear it; the stamp says when it happened. Who reads the rail live
    /// passes it over, and so does who was there already at the time of its stamp.
    pub const AGAIN: u32 = 1;
}

payload! {
    /// Something happened, on `stack/events`. Tail: JSON, see [`crate::event::EventBody`].
    pub struct Event: "dinrail.Event/1", tail, Json {
        /// [`event_flag`]s.
        pub flags: u32,
        /// Bytes of the tail.
        pub n: u32,
    }
}

payload! {
    /// A request to a service on `<svc>/jobs`; its identity is (writer, generation, seq). Tail: JSON object with
    /// the key `do`.
    pub struct Job: "dinrail.Job/1", tail, Ros1 {
        /// CLOCK_MONOTONIC in ns after which nobody waits any more; the service drops it then.
        pub deadline_t_ns: u64,
        /// Reserved, 0.
        pub reserved: u32,
        /// Bytes of the tail.
        pub n: u32,
    }
}

payload! {
    /// The answer to a job, on `<svc>/results`; readers pick theirs by writer and seq. Tail: JSON object with
    /// the key `ok` or `error`.
    pub struct JobResult: "dinrail.JobResult/1", tail, Ros1 {
        /// `stamp.seq` of the job.
        pub job_seq: u64,
        /// `stamp.writer` of the job.
        pub job_writer: u32,
        /// `stamp.generation` of the job.
        pub job_generation: u32,
        /// 0 done, 1 failed, 2 expired, 3 not supported.
        pub code: u32,
        /// Bytes of the tail.
        pub n: u32,
    }
}
