use super::*;
use proptest::prelude::*;

const MS: u64 = 1_000_000;

fn plan() -> Plan {
    Plan {
        id: 5,
        identity: Identity {
            device_type: Some(0x191),
            vendor: Some(1),
            serial: Some(9),
            ..Identity::default()
        },
        writes: vec![
            Write { index: 0x1017, sub: 0, data: vec![100, 0] },
            Write { index: 0x1800, sub: 2, data: vec![1] },
        ],
        error_control: ErrorControl::Heartbeat { consumer_ns: 300 * MS },
        sdo_tries: 3,
        ..Plan::default()
    }
}

fn actions(boot: &mut Boot) -> Vec<Action> {
    boot.drain().collect()
}

fn read(index: u16, sub: u8) -> Vec<Action> {
    vec![Action::Read { index, sub }]
}

fn value(n: u32) -> SdoEnd {
    SdoEnd::Read(n.to_le_bytes().to_vec())
}

/// Identity right, reset, boot-up: the first write is asked for.
fn to_download(boot: &mut Boot) {
    boot.start(0);
    assert_eq!(actions(boot), read(0x1000, 0));
    boot.on_sdo(1, &value(0x191));
    assert_eq!(actions(boot), read(0x1018, 1));
    boot.on_sdo(2, &value(1));
    assert_eq!(actions(boot), read(0x1018, 4));
    boot.on_sdo(3, &value(9));
    assert_eq!(actions(boot), [Action::ResetCommunication]);
    boot.on_boot_up(4);
}

fn failure(boot: &mut Boot) -> Failure {
    match actions(boot).pop() {
        Some(Action::Failed(failure)) => failure,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_node_is_identified_reset_configured_and_watched() {
    let mut boot = Boot::new(plan());
    to_download(&mut boot);
    assert_eq!(actions(&mut boot), [Action::Write(plan().writes[0].clone())]);
    boot.on_sdo(5, &SdoEnd::Written);
    assert_eq!(actions(&mut boot), [Action::Write(plan().writes[1].clone())]);
    boot.on_sdo(6, &SdoEnd::Written);
    assert_eq!(actions(&mut boot), [Action::StartErrorControl]);
    boot.on_alive(7, 127);
    assert_eq!(actions(&mut boot), [Action::Done { kept: false }]);
    assert!(boot.is_running());
    // Lost: tried again after a pause; back by itself: at once, and not reset a second time.
    boot.on_lost(10);
    assert_eq!(boot.next_deadline(), Some(10 + RETRY_NS));
    boot.on_boot_up(20);
    assert_eq!(actions(&mut boot), read(0x1000, 0));
    boot.on_sdo(21, &value(0x191));
    boot.on_sdo(22, &value(1));
    boot.drain();
    boot.on_sdo(23, &value(9));
    assert_eq!(actions(&mut boot), [Action::Write(plan().writes[0].clone())]);
}

#[test]
fn a_silent_node_is_letter_b_and_tried_for_ever() {
    let mut boot = Boot::new(plan());
    boot.start(0);
    let mut now = 0;
    for attempt in 1..5 {
        for _ in 0..3 {
            assert_eq!(actions(&mut boot), read(0x1000, 0));
            now += 500 * MS;
            boot.on_sdo(now, &SdoEnd::Timeout);
        }
        let failed = failure(&mut boot);
        assert_eq!((failed.letter, failed.attempt), (Letter::B, attempt));
        now += RETRY_NS;
        boot.on_time(now);
    }
}

#[test]
fn identity_letters() {
    for (answers, letter, expected) in
        [(vec![0x192], Letter::C, 0x191), (vec![0x191, 2], Letter::D, 1), (vec![0x191, 1, 8], Letter::O, 9)]
    {
        let mut boot = Boot::new(plan());
        boot.start(0);
        for answer in &answers {
            boot.drain();
            boot.on_sdo(1, &value(*answer));
        }
        let failed = failure(&mut boot);
        assert_eq!(
            (failed.letter, failed.expected, failed.got),
            (letter, Some(expected), answers.last().copied())
        );
    }
    let mut boot = Boot::new(Plan {
        identity: Identity { product: Some(1), revision: Some(2), ..Identity::default() },
        ..plan()
    });
    boot.start(0);
    boot.on_sdo(1, &value(0));
    boot.drain();
    boot.on_sdo(1, &SdoEnd::Abort(0x0602_0000));
    assert_eq!(failure(&mut boot).letter, Letter::M);
}

#[test]
fn a_refused_configuration_names_object_and_abort_code() {
    let mut boot = Boot::new(plan());
    to_download(&mut boot);
    boot.on_sdo(5, &SdoEnd::Written);
    boot.drain();
    boot.on_sdo(6, &SdoEnd::Abort(0x0609_0030));
    let failed = failure(&mut boot);
    assert_eq!(
        (failed.letter, failed.object, failed.abort),
        (Letter::J, Some((0x1800, 2)), Some(0x0609_0030))
    );
    // A node that dies while it is configured.
    let mut boot = Boot::new(plan());
    to_download(&mut boot);
    for _ in 0..3 {
        boot.drain();
        boot.on_sdo(7, &SdoEnd::Timeout);
    }
    assert_eq!(failure(&mut boot).letter, Letter::J);
}

#[test]
fn a_running_node_is_kept_alive() {
    let keep = || Plan { keep_alive: true, identity: Identity::default(), ..plan() };
    let mut boot = Boot::new(keep());
    boot.start(0);
    boot.drain();
    boot.on_sdo(1, &value(0x191));
    assert_eq!(actions(&mut boot), [Action::StartErrorControl]);
    boot.on_alive(2, OPERATIONAL);
    assert_eq!(actions(&mut boot), [Action::StartErrorControl]);
    boot.on_alive(3, OPERATIONAL);
    assert_eq!(actions(&mut boot), [Action::Done { kept: true }]);
    // Not operational, or silent: reset as usual.
    for state in [Some(127), None] {
        let mut boot = Boot::new(keep());
        boot.start(0);
        boot.drain();
        boot.on_sdo(1, &value(0x191));
        boot.drain();
        match state {
            Some(state) => boot.on_alive(2, state),
            None => boot.on_time(1 + 300 * MS),
        }
        assert_eq!(actions(&mut boot), [Action::ResetCommunication]);
    }
}

#[test]
fn an_equal_configuration_date_skips_the_download() {
    let stamped = Plan { identity: Identity::default(), config_stamp: Some((7, 8)), ..plan() };
    for (date, time, loads) in [(7, 8, false), (7, 9, true), (6, 8, true)] {
        let mut boot = Boot::new(stamped.clone());
        boot.start(0);
        boot.on_sdo(1, &value(0));
        boot.on_boot_up(2);
        boot.drain();
        boot.on_sdo(3, &value(date));
        assert_eq!(actions(&mut boot), read(0x1020, 2));
        boot.on_sdo(4, &value(time));
        let expected = (7, 8);
        assert_eq!(boot.loaded(), loads.then_some(Loaded { had: Some((date, time)), expected }));
        let next = actions(&mut boot);
        assert_eq!(matches!(next[..], [Action::Write(_)]), loads, "{next:?}");
        if loads {
            for _ in 0..2 {
                boot.on_sdo(5, &SdoEnd::Written);
            }
            let stamp =
                |sub, n: u32| Action::Write(Write { index: 0x1020, sub, data: n.to_le_bytes().to_vec() });
            assert_eq!(actions(&mut boot).pop(), Some(stamp(1, 7)));
            boot.on_sdo(6, &SdoEnd::Written);
            assert_eq!(actions(&mut boot).pop(), Some(stamp(2, 8)));
            boot.on_sdo(6, &SdoEnd::Written);
            assert_eq!(actions(&mut boot), [Action::StartErrorControl]);
        }
    }
}

#[test]
fn a_device_that_tells_no_configuration_date_is_loaded() {
    let plan = Plan { identity: Identity::default(), config_stamp: Some((7, 8)), ..plan() };
    for refused in [1, 2] {
        let mut boot = Boot::new(plan.clone());
        boot.start(0);
        boot.on_sdo(1, &value(0));
        boot.on_boot_up(2);
        for _ in 1..refused {
            boot.on_sdo(3, &value(7));
        }
        boot.drain();
        boot.on_sdo(4, &SdoEnd::Abort(0x0602_0000));
        assert_eq!(actions(&mut boot), [Action::Write(plan.writes[0].clone())]);
        assert_eq!(boot.loaded(), Some(Loaded { had: None, expected: (7, 8) }));
    }
}

#[test]
fn defaults_are_restored_before_the_download() {
    let mut boot = Boot::new(Plan { identity: Identity::default(), restore: Some(1), ..plan() });
    boot.start(0);
    boot.on_sdo(1, &value(0));
    boot.drain();
    boot.on_boot_up(2);
    let load = Write { index: 0x1011, sub: 1, data: b"load".to_vec() };
    assert_eq!(actions(&mut boot), [Action::Write(load)]);
    boot.on_sdo(3, &SdoEnd::Written);
    assert_eq!(actions(&mut boot), [Action::ResetCommunication]);
    boot.on_boot_up(4);
    assert_eq!(actions(&mut boot), [Action::Write(plan().writes[0].clone())]);
}

#[test]
fn error_control_that_never_starts_is_letter_e_or_f() {
    for (control, letter) in [
        (ErrorControl::Heartbeat { consumer_ns: 300 * MS }, Letter::E),
        (ErrorControl::Guarding { guard_ns: 100 * MS, factor: 3 }, Letter::F),
    ] {
        let mut boot = Boot::new(Plan { error_control: control, ..plan() });
        to_download(&mut boot);
        boot.on_sdo(5, &SdoEnd::Written);
        boot.on_sdo(6, &SdoEnd::Written);
        boot.drain();
        boot.on_time(6 + 300 * MS);
        assert_eq!(failure(&mut boot).letter, letter);
    }
}

proptest! {
    /// Whatever happens in whatever order: after a quiet time with a good node it runs.
    #[test]
    fn it_always_recovers(steps in prop::collection::vec(0u8..7, 0..60)) {
        let mut boot = Boot::new(plan());
        boot.start(0);
        let mut now = 0;
        for step in steps {
            now += 50 * MS;
            match step {
                0 => boot.on_boot_up(now),
                1 => boot.on_alive(now, OPERATIONAL),
                2 => boot.on_lost(now),
                3 => boot.on_sdo(now, &SdoEnd::Timeout),
                4 => boot.on_sdo(now, &SdoEnd::Abort(0x0800_0000)),
                5 => boot.on_sdo(now, &value(3)),
                _ => boot.on_time(now),
            }
            let _ = boot.drain().count();
        }
        // Every transfer ends.
        for _ in 0..3 {
            boot.on_sdo(now, &SdoEnd::Timeout);
        }
        boot.on_lost(now);
        for _ in 0..200 {
            now += 100 * MS;
            boot.on_time(now);
            for action in boot.drain().collect::<Vec<_>>() {
                match action {
                    Action::Read { index: 0x1000, .. } => boot.on_sdo(now, &value(0x191)),
                    Action::Read { sub: 4, .. } => boot.on_sdo(now, &value(9)),
                    Action::Read { .. } => boot.on_sdo(now, &value(1)),
                    Action::Write(_) => boot.on_sdo(now, &SdoEnd::Written),
                    Action::ResetCommunication => boot.on_boot_up(now),
                    _ => {}
                }
            }
            boot.on_alive(now, 127);
        }
        prop_assert!(boot.is_running(), "{}", boot.step_text());
    }
}
