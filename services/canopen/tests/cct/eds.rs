//! The demo device's dictionary.

use dinrail_canopen::protocol::eds::{BuildOptions, Eds};
use dinrail_canopen::protocol::od::OdBuilder;

pub fn builder(text: &str) -> OdBuilder {
    Eds::parse(text.as_bytes())
        .unwrap()
        .builder(&BuildOptions { string_capacity: 1000, ..BuildOptions::default() })
}
