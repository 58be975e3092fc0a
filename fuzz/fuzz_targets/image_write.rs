//! Image writes: any tail is refused or is a list of operations that can be written again; an operation changes
//! its area within its bytes or not at all.

#![no_main]

use ipc_types::image_write::{Builder, MAX_BYTES, MAX_OPS, Op, WriteError, parse};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let ops: Vec<Op<'_>> = match parse(data) {
        Ok(ops) => ops.collect(),
        Err(error) => return assert!(!error.to_string().is_empty()),
    };
    assert!(ops.len() <= MAX_OPS);
    let mut builder = Builder::default();
    let mut fits = true;
    for op in &ops {
        let mut area = [0x5A; 64];
        let before = area;
        if op.apply(&mut area) {
            let from = op.offset() as usize;
            assert!(from + op.len() <= area.len());
            assert_eq!(area[..from], before[..from]);
            assert_eq!(area[from + op.len()..], before[from + op.len()..]);
        } else {
            assert_eq!(area, before);
        }
        if let Err(error) = builder.push(op) {
            assert_eq!(error, WriteError::TooLong);
            fits = false;
        }
    }
    if fits {
        assert!(builder.tail().len() <= MAX_BYTES);
        assert_eq!(parse(builder.tail()).unwrap().collect::<Vec<_>>(), ops);
    } else {
        assert!(data.len() > MAX_BYTES);
    }
});
