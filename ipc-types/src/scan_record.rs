//! Content of scan records and keyframes.
