//! The trait every message header implements, and the macro that writes it from the struct.
#![allow(unsafe_code)]

use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

/// Who sent a message, when, and which one it is. Filled by the port, never by hand.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stamp {
    /// Number of the message within (writer, generation), from 1, without holes.
    pub seq: u64,
    /// CLOCK_MONOTONIC in ns.
    pub t_ns: u64,
    /// Bumped at each restart of the writer, from 1.
    pub generation: u32,
    /// Index of the service in the stack; command-line tools use `0x8000_0000 | pid`.
    pub writer: u32,
}

/// How a message stands in a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// Header and tail as ROS 1 packed bytes with a `ros1msg` schema.
    Ros1,
    /// The tail alone, which is JSON.
    Json,
}

/// A message header.
///
/// # Safety
/// `Self` is `repr(C)`, has no padding, no pointers, any bit pattern is valid, starts with [`Stamp`], and, when
/// `TAIL`, ends with `n: u32`. The `payload!` macro proves all of this at compile time.
pub unsafe trait Payload: ZeroCopySend + Copy + Default + std::fmt::Debug + 'static {
    /// Type name on the rail and in recordings, with version: `dinrail.CanFrame/1`.
    const NAME: &'static str;
    /// Whether the header ends with `n: u32` and a tail follows.
    const TAIL: bool;
    /// How the recorder writes it.
    const ENCODING: Encoding;
    /// The stamp.
    fn stamp(&self) -> &Stamp;
    /// The stamp, for the port.
    fn stamp_mut(&mut self) -> &mut Stamp;
    /// Length of the tail as the header states it (0 without tail).
    fn tail_len(&self) -> u32;
    /// States the length of the tail.
    fn set_tail_len(&mut self, n: u32);
    /// The `ros1msg` text of header and tail.
    fn ros1msg() -> String;
}

/// Names a field's type in `ros1msg`.
pub trait Ros1Field {
    /// One or more lines `type name`.
    fn lines(name: &str, out: &mut String);
}

macro_rules! ros1_field {
    ($($rust:ty => $ros:literal),*) => {$(
        impl Ros1Field for $rust {
            fn lines(name: &str, out: &mut String) {
                out.push_str(&format!("{} {name}\n", $ros));
            }
        }
        impl<const N: usize> Ros1Field for [$rust; N] {
            fn lines(name: &str, out: &mut String) {
                out.push_str(&format!("{}[{N}] {name}\n", $ros));
            }
        }
    )*};
}
ros1_field!(u8 => "uint8", i8 => "int8", u16 => "uint16", i16 => "int16", u32 => "uint32", i32 => "int32",
            u64 => "uint64", i64 => "int64", f32 => "float32", f64 => "float64");

impl Ros1Field for Stamp {
    fn lines(_name: &str, out: &mut String) {
        out.push_str("uint64 seq\nuint64 t_ns\nuint32 generation\nuint32 writer\n");
    }
}

// SAFETY: plain integers, repr(C), no pointers.
unsafe impl ZeroCopySend for Stamp {}

/// The bytes of a header.
pub fn as_bytes<T: Payload>(header: &T) -> &[u8] {
    // SAFETY: `Payload` promises no padding, so every byte is initialised; the lifetime is the header's.
    unsafe { std::slice::from_raw_parts(std::ptr::from_ref(header).cast::<u8>(), size_of::<T>()) }
}

/// A header from bytes, e.g. of a recording. `None` when too short.
pub fn from_bytes<T: Payload>(bytes: &[u8]) -> Option<T> {
    if bytes.len() < size_of::<T>() {
        return None;
    }
    // SAFETY: length checked; `Payload` promises that any bit pattern is valid; unaligned read is asked for.
    Some(unsafe { std::ptr::read_unaligned(bytes.as_ptr().cast::<T>()) })
}

/// Declares a message header. The forms are `struct Name: "type name", tail|fixed, Encoding { fields }`.
macro_rules! payload {
    (@tail tail, $self:ident) => { $self.n };
    (@tail fixed, $self:ident) => { 0 };
    (@set tail, $self:ident, $n:ident) => { $self.n = $n };
    (@set fixed, $self:ident, $n:ident) => { let _ = ($self, $n); };
    (@is tail) => { true };
    (@is fixed) => { false };
    (@data tail, $out:ident) => { $out.push_str("uint8[] data\n") };
    (@data fixed, $out:ident) => {};
    (@last tail, $name:ident) => {
        const _: () = assert!(
            std::mem::offset_of!($name, n) + 4 == size_of::<$name>(),
            "n must be the last member"
        );
    };
    (@last fixed, $name:ident) => {};
    ($(#[$doc:meta])* pub struct $name:ident: $type_name:literal, $kind:ident, $encoding:ident {
        $($(#[$fdoc:meta])* pub $field:ident: $ty:ty,)*
    }) => {
        $(#[$doc])*
        #[repr(C)]
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct $name {
            /// Who, when, which.
            pub stamp: $crate::payload::Stamp,
            $($(#[$fdoc])* pub $field: $ty,)*
        }

        impl Default for $name {
            fn default() -> Self {
                Self { stamp: $crate::payload::Stamp::default(), $($field: $crate::payload::plumbing::zero(),)* }
            }
        }

        const _: () = assert!(
            size_of::<$name>() == size_of::<$crate::payload::Stamp>() $(+ size_of::<$ty>())*,
            concat!(stringify!($name), " has padding")
        );
        const _: () = assert!(std::mem::offset_of!($name, stamp) == 0);
        payload!(@last $kind, $name);

        // SAFETY: repr(C), integers, floats and arrays of them only (Ros1Field), no pointers.
        unsafe impl iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend for $name {
            unsafe fn type_name() -> &'static str { $type_name }
        }
        // SAFETY: the assertions above prove the layout; members are Ros1Field, so any bit pattern is valid.
        unsafe impl $crate::payload::Payload for $name {
            const NAME: &'static str = $type_name;
            const TAIL: bool = payload!(@is $kind);
            const ENCODING: $crate::payload::Encoding = $crate::payload::Encoding::$encoding;
            fn stamp(&self) -> &$crate::payload::Stamp { &self.stamp }
            fn stamp_mut(&mut self) -> &mut $crate::payload::Stamp { &mut self.stamp }
            fn tail_len(&self) -> u32 { payload!(@tail $kind, self) }
            fn set_tail_len(&mut self, n: u32) { payload!(@set $kind, self, n); }
            fn ros1msg() -> String {
                use $crate::payload::plumbing::Ros1Field;
                let mut out = String::new();
                <$crate::payload::Stamp as Ros1Field>::lines("stamp", &mut out);
                $(
                    if !(Self::TAIL && stringify!($field) == "n") {
                        <$ty as Ros1Field>::lines(stringify!($field), &mut out);
                    }
                )*
                payload!(@data $kind, out);
                out
            }
        }
    };
}
pub(crate) use payload;

/// Zero of any member type.
pub trait Zero {
    /// The zero.
    const ZERO: Self;
}
macro_rules! zeros {
    ($($t:ty => $z:expr),*) => {$(
        impl Zero for $t { const ZERO: Self = $z; }
        impl<const N: usize> Zero for [$t; N] { const ZERO: Self = [$z; N]; }
    )*};
}
zeros!(u8 => 0, i8 => 0, u16 => 0, i16 => 0, u32 => 0, i32 => 0, u64 => 0, i64 => 0, f32 => 0.0, f64 => 0.0);

/// Zero, with the type inferred.
pub fn zero<T: Zero>() -> T {
    T::ZERO
}
