use super::*;
use proptest::prelude::*;

fn sample() -> ObjectDictionary {
    #[allow(clippy::enum_glob_use)]
    use DataType::*;
    let mut b = OdBuilder::new();
    b.var(0x1000, EntryDef::new(Unsigned32, Access::Ro).value(0x000F_0191))
        .var(0x1005, EntryDef::new(Unsigned32, Access::Rw).value(0x80))
        .var(0x1008, EntryDef::new(VisibleString, Access::Const).bytes(b"box").capacity(8))
        .array(0x1003, 4, EntryDef::new(Unsigned32, Access::Ro))
        .var(0x1014, EntryDef::new(Unsigned32, Access::Rw).value_plus_node_id(0x80))
        .record(
            0x2000,
            Access::Const,
            vec![
                (1, EntryDef::new(Integer8, Access::Rw).limits(Number::Int(-5), Number::Int(5))),
                (2, EntryDef::new(Real32, Access::Rw).limits(Number::Real(-1.0), Number::Real(1.0))),
                (3, EntryDef::new(Boolean, Access::Rww).mappable()),
                (4, EntryDef::new(Unsigned24, Access::Wo)),
                (9, EntryDef::new(UnicodeString, Access::Rw).capacity(6)),
                (10, EntryDef::new(Domain, Access::Rw).capacity(1000)),
                (11, EntryDef::new(Other(0x41), Access::Rw).capacity(3)),
                (12, EntryDef::new(Integer64, Access::Rwr).value(-2)),
            ],
        )
        .dummy(5);
    b.build(4).unwrap()
}

#[test]
fn every_check_has_its_abort_code() {
    let mut od = sample();
    type Row<'a> = (u16, u8, &'a [u8], Result<(), Abort>);
    let table: &[Row] = &[
        (0x1004, 0, &[0], Err(Abort::NO_OBJECT)),
        (0x1000, 1, &[0], Err(Abort::NO_SUB_INDEX)),
        (0x2000, 5, &[0], Err(Abort::NO_SUB_INDEX)),
        (0x2000, 0xFF, &[0], Err(Abort::NO_SUB_INDEX)),
        // the access right comes before the length, the length before the value
        (0x1000, 0, &[0; 9], Err(Abort::READ_ONLY)),
        (0x1008, 0, b"new", Err(Abort::READ_ONLY)),
        (0x1005, 0, &[0; 5], Err(Abort::TOO_LONG)),
        (0x1005, 0, &[0; 3], Err(Abort::TOO_SHORT)),
        (0x1005, 0, &[], Err(Abort::TOO_SHORT)),
        (0x1005, 0, &[0x81, 0, 0, 0], Ok(())),
        (0x2000, 1, &[6], Err(Abort::TOO_HIGH)),
        (0x2000, 1, &[0xFA], Err(Abort::TOO_LOW)),
        (0x2000, 1, &[0xFB], Ok(())),
        (0x2000, 2, &1.5f32.to_le_bytes(), Err(Abort::TOO_HIGH)),
        (0x2000, 2, &f32::NAN.to_le_bytes(), Err(Abort::INVALID_VALUE)),
        (0x2000, 2, &(-0.5f32).to_le_bytes(), Ok(())),
        (0x2000, 3, &[2], Err(Abort::INVALID_VALUE)),
        (0x2000, 3, &[1], Ok(())),
        (0x2000, 4, &[1, 2, 3], Ok(())),
        (0x2000, 4, &[1, 2, 3, 4], Err(Abort::TOO_LONG)),
        (0x2000, 9, &[1, 2, 3], Err(Abort::TYPE_MISMATCH)),
        (0x2000, 9, &[1, 2, 3, 4], Ok(())),
        (0x2000, 9, &[0; 8], Err(Abort::TOO_LONG)),
        (0x2000, 10, &[7; 1000], Ok(())),
        (0x2000, 10, &[7; 1001], Err(Abort::TOO_LONG)),
        (0x2000, 10, &[], Ok(())),
        (0x2000, 11, &[1, 2], Ok(())),
    ];
    for &(index, sub, data, ref want) in table {
        assert_eq!(od.write(index, sub, data), *want, "{index:04X}:{sub:02X} {data:?}");
        if want.is_ok() {
            assert_eq!(od.bytes(index, sub), Some(data));
        }
    }
    assert_eq!(od.read(0x2000, 4), Err(Abort::WRITE_ONLY));
    assert_eq!(od.read(0x2000, 13), Err(Abort::NO_SUB_INDEX));
    assert_eq!(od.read(0x0FFF, 0), Err(Abort::NO_OBJECT));
    assert_eq!(od.read(0x2000, 10), Ok(&[][..]));
}

#[test]
fn typed_values() {
    let mut od = sample();
    assert_eq!(od.u32(0x1000, 0), Some(0x000F_0191));
    assert_eq!(od.u16(0x1000, 0), None);
    assert_eq!(od.u8(0x1003, 0), Some(4));
    assert_eq!(od.text(0x1008, 0), Some("box"));
    assert_eq!(od.i64(0x2000, 12), Some(-2));
    assert_eq!(od.u64(0x2000, 12), None);
    od.set_uint(0x2000, 4, 0x00AB_CDEF).unwrap();
    assert_eq!(od.u32(0x2000, 4), Some(0x00AB_CDEF));
    assert_eq!(od.set_uint(0x2000, 4, 0x0100_0000), Err(Abort::INVALID_VALUE));
    assert_eq!(od.set_uint(0x1008, 0, 1), Err(Abort::TYPE_MISMATCH));
    od.set_int(0x2000, 1, -7).unwrap(); // the device itself is not held by the limits
    assert_eq!(od.i64(0x2000, 1), Some(-7));
    od.set_f64(0x2000, 2, 0.25).unwrap();
    assert_eq!(od.f64(0x2000, 2), Some(0.25));
    od.set_bytes(0x1008, 0, b"longer").unwrap();
    assert_eq!(od.text(0x1008, 0), Some("longer"));
    assert_eq!(od.set_bytes(0x1008, 0, b"too long!"), Err(Abort::TOO_LONG));
    assert_eq!(od.bool(0x2000, 3), Some(false));
    assert_eq!(od.u8(0x9999, 0), None);
}

#[test]
fn defaults_follow_the_node_id() {
    let mut od = sample();
    assert_eq!(od.u32(0x1014, 0), Some(0x84));
    od.set_uint(0x1005, 0, 0x99).unwrap();
    od.set_node_id(0x7F);
    assert_eq!(od.u32(0x1014, 0), Some(0x84), "values wait for the reset");
    od.reset_to_defaults(0x1000..=0x1004);
    assert_eq!((od.u32(0x1014, 0), od.u32(0x1005, 0)), (Some(0x84), Some(0x99)));
    od.reset_to_defaults(0x1000..=0x1FFF);
    assert_eq!((od.u32(0x1014, 0), od.u32(0x1005, 0)), (Some(0xFF), Some(0x80)));
}

#[test]
fn handles_and_iteration() {
    let mut od = sample();
    let flag = od.find(0x2000, 3).unwrap();
    assert_eq!(od.entry(flag).unwrap().pdo_bits(), Some(1));
    od.get_mut(flag)[0] = 1;
    assert_eq!(od.get(flag), [1]);
    assert_eq!(od.entries_of(0x1003).map(|(_, entry)| entry.sub).collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
    assert_eq!(od.entries_of(0x1234).count(), 0);
    let keys: Vec<_> = od.entries().map(|(_, entry)| (entry.index, entry.sub)).collect();
    assert!(keys.is_sorted());
    assert_eq!(od.object(0x2000).unwrap().code, ObjectCode::Record);
    assert_eq!(od.largest(), 1000);
    assert!(od.dummy_allowed(5) && !od.dummy_allowed(6) && !od.dummy_allowed(0x25));
    let stranger = EntryRef(9999);
    assert_eq!(od.get(stranger), [0; 0]);
    assert_eq!(od.set(stranger, &[1]), Err(Abort::INTERNAL));
    assert!(od.get_mut(stranger).is_empty());
}

#[test]
fn faults_of_the_builder() {
    #[allow(clippy::enum_glob_use)]
    use DataType::*;
    let var = |data_type| EntryDef::new(data_type, Access::Rw);
    let build = |f: &dyn Fn(&mut OdBuilder)| {
        let mut b = OdBuilder::new();
        f(&mut b);
        b.build(1).map(|_| ()).map_err(|error| error.to_string())
    };
    let mut got = String::new();
    for fault in [
        build(&|b| {
            b.var(0x2000, var(Unsigned8)).var(0x2000, var(Unsigned8));
        }),
        build(&|b| {
            b.record(0x2000, Access::Ro, vec![(1, var(Unsigned8)), (1, var(Unsigned8))]);
        }),
        build(&|b| {
            b.object(ObjectDef { index: 0x2000, code: ObjectCode::Array, subs: vec![] });
        }),
        build(&|b| {
            b.var(0x2000, var(Unsigned16).bytes(&[1]));
        }),
        build(&|b| {
            b.var(0x2000, var(Identity));
        }),
        build(&|b| {
            b.var(0x2000, var(Domain).capacity(u32::MAX));
        }),
        build(&|b| {
            b.var(0x2000, var(Real32).value_plus_node_id(1));
        }),
        build(&|b| {
            for index in 0..5 {
                b.var(index, var(Domain).capacity(16 << 20));
            }
        }),
    ] {
        got.push_str(&fault.unwrap_err());
        got.push('\n');
    }
    insta::assert_snapshot!(got);
}

struct Guard {
    seen: Vec<String>,
}

impl Hooks for Guard {
    fn before_read(&mut self, od: &mut ObjectDictionary, index: u16, sub: u8) -> Result<(), Abort> {
        self.seen.push(format!("read {index:04X}:{sub}"));
        if index == 0x1000 {
            return Err(Abort::DEVICE_STATE);
        }
        od.set_uint(0x1005, 0, 0x1234)
    }
    fn before_write(
        &mut self,
        od: &mut ObjectDictionary,
        index: u16,
        _: u8,
        data: &[u8],
    ) -> Result<Accept, Abort> {
        match (index, data[0]) {
            (0x1005, 1) => Ok(Accept::Store),
            (0x1005, 2) => {
                od.set_uint(0x2000, 4, 77)?;
                Ok(Accept::Taken)
            }
            _ => Err(Abort::LOCAL_CONTROL),
        }
    }
    fn after_write(&mut self, od: &mut ObjectDictionary, index: u16, sub: u8) {
        self.seen.push(format!("wrote {index:04X}:{sub} {:?}", od.u32(index, sub)));
    }
}

#[test]
fn the_owner_takes_part() {
    let mut od = sample();
    let mut guard = Guard { seen: Vec::new() };
    assert_eq!(od.read_hooked(&mut guard, 0x1000, 0), Err(Abort::DEVICE_STATE));
    assert_eq!(od.read_hooked(&mut guard, 0x1005, 0), Ok(&[0x34, 0x12, 0, 0][..]));
    assert_eq!(od.write_hooked(&mut guard, 0x1005, 0, &[1, 0, 0, 0]), Ok(()));
    assert_eq!(od.write_hooked(&mut guard, 0x1005, 0, &[2, 0, 0, 0]), Ok(()));
    assert_eq!(od.write_hooked(&mut guard, 0x1005, 0, &[3, 0, 0, 0]), Err(Abort::LOCAL_CONTROL));
    assert_eq!(od.write_hooked(&mut guard, 0x1005, 0, &[3]), Err(Abort::TOO_SHORT));
    assert_eq!((od.u32(0x1005, 0), od.u32(0x2000, 4)), (Some(1), Some(77)));
    assert_eq!(guard.seen, ["read 1000:0", "read 1005:0", "wrote 1005:0 Some(1)", "wrote 1005:0 Some(1)"]);
}

proptest! {
    #[test]
    fn any_write_is_stored_whole_or_not_at_all(index in 0x0FFEu16..0x2002, sub: u8, data: Vec<u8>) {
        let mut od = sample();
        let before: Vec<Vec<u8>> = od.entries().map(|(at, _)| od.get(at).to_vec()).collect();
        let result = od.write(index, sub, &data);
        for ((at, entry), old) in od.entries().zip(&before) {
            if result.is_ok() && (entry.index, entry.sub) == (index, sub) {
                prop_assert_eq!(od.get(at), &data[..]);
            } else {
                prop_assert_eq!(od.get(at), &old[..]);
            }
        }
    }
}
