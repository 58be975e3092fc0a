//! Supervision in virtual time.

use super::policy::*;
use ipc_types::event::{EventKind, Level};
use ipc_types::payload::HealthState;
use proptest::prelude::*;

const MS: u64 = 1_000_000;
const S: u64 = 1_000_000_000;
const TERM_GRACE_NS: u64 = 2 * S;

fn policy(rules: Vec<Rule>) -> Policy {
    let names = ["can0", "plc", "rec", "modbus"];
    Policy::new(rules.into_iter().zip(names).map(|(r, n)| (n.to_owned(), r)).collect(), TERM_GRACE_NS)
}

fn death() -> Death {
    Death { how: "killed by SIGKILL".into(), detail: serde_json::json!({ "signal": "SIGKILL" }) }
}

/// What was done, without the events.
fn done(policy: &mut Policy) -> Vec<Action> {
    policy.take().into_iter().filter(|a| !matches!(a, Action::Tell(_))).collect()
}

fn told(policy: &mut Policy) -> Vec<EventKind> {
    let tell = |a| match a {
        Action::Tell(notice) => Some(notice.kind),
        _ => None,
    };
    policy.take().into_iter().filter_map(tell).collect()
}

fn running(rules: Vec<Rule>) -> Policy {
    let mut p = policy(rules);
    p.start(0);
    // Twice: the recorders come first.
    for i in (0..p.slots().len()).chain(0..p.slots().len()) {
        p.beat(i, 1, HealthState::Ready, 10 * MS);
    }
    p.take();
    p
}

#[test]
fn recorders_start_first_and_stop_last() {
    let rec = Rule { recorder: true, ..Rule::default() };
    let mut p = policy(vec![Rule::default(), Rule::default(), rec, Rule::default()]);
    let spawned = |p: &mut Policy| -> Vec<usize> {
        let service = |a: &Action| match a {
            Action::Spawn { service, generation: 1 } => Some(*service),
            _ => None,
        };
        done(p).iter().filter_map(service).collect()
    };
    p.start(0);
    assert_eq!(spawned(&mut p), [2]);
    p.beat(2, 1, HealthState::Ready, 20 * MS);
    assert_eq!(spawned(&mut p), [0, 1, 3]);
    p.stop("asked", S);
    for service in [3, 1, 0, 2] {
        assert_eq!(done(&mut p), [Action::Signal { service, signal: Kill::Term }]);
        p.died(service, death(), S);
    }
    assert_eq!(done(&mut p), [Action::Ended]);
    assert!(p.ended() && p.failed().is_none());
}

#[test]
fn a_full_dev_shm_costs_no_budget_and_fails_no_stack() {
    let mut p = running(vec![Rule::default()]);
    p.died(0, death(), S);
    assert_eq!(done(&mut p), [Action::Clean]);
    let mut now = S;
    for _ in 0..20 {
        p.clean_has_no_room(now);
        assert_eq!(done(&mut p), []);
        now = p.next_deadline().unwrap();
        p.tick(now);
        assert_eq!(done(&mut p), [Action::Clean]);
    }
    p.clean_done(Ok(()), now);
    assert!(done(&mut p).contains(&Action::Spawn { service: 0, generation: 2 }));
    assert!(p.failed().is_none());
}

#[test]
fn a_recorder_that_does_not_get_ready_keeps_nobody_waiting_for_ever() {
    let rec = Rule { recorder: true, ..Rule::default() };
    let mut p = policy(vec![rec, Rule::default()]);
    p.start(0);
    assert_eq!(done(&mut p).len(), 1);
    assert_eq!(p.next_deadline(), Some(RECORDER_HEAD_START_NS));
    p.tick(RECORDER_HEAD_START_NS);
    assert_eq!(done(&mut p), [Action::Spawn { service: 1, generation: 1 }]);
}

#[test]
fn the_first_restart_is_at_once_then_the_delay_doubles_until_the_budget_is_used_up() {
    let mut p = running(vec![Rule::default(), Rule::default()]);
    let mut now = S;
    let mut delays = Vec::new();
    for generation in 2..=6 {
        p.died(0, death(), now);
        assert_eq!(done(&mut p), [Action::Clean]);
        p.clean_done(Ok(()), now);
        let due = p.next_deadline();
        delays.push(due.map_or(0, |t| (t - now) / MS));
        if let Some(t) = due {
            assert!(done(&mut p).is_empty());
            p.tick(t - 1);
            assert!(done(&mut p).is_empty());
            now = t;
            p.tick(now);
        }
        assert_eq!(done(&mut p), [Action::Spawn { service: 0, generation }]);
        p.beat(0, generation, HealthState::Ready, now);
        p.take();
    }
    assert_eq!(delays, [0, 50, 100, 200, 400]);
    p.died(0, death(), now);
    p.clean_done(Ok(()), now);
    let all = p.take();
    assert!(all.contains(&Action::CloseListeners { service: 0 }));
    assert!(all.iter().any(|a| matches!(a, Action::Tell(n) if n.kind == EventKind::Held)));
    assert_eq!(p.slots()[0].phase, Phase::Held);
    assert_eq!(p.slots()[1].phase, Phase::Running, "the neighbour works on");
    // A restart by hand ends the hold and the budget is fresh.
    assert_eq!(p.restart(0, now), Ok(7));
    assert_eq!(done(&mut p), [Action::Spawn { service: 0, generation: 7 }]);
    p.died(0, death(), now);
    p.clean_done(Ok(()), now);
    assert!(done(&mut p).contains(&Action::Spawn { service: 0, generation: 8 }));
}

#[test]
fn a_healthy_run_resets_budget_and_back_off() {
    let mut p = running(vec![Rule { max: 1, ..Rule::default() }]);
    let mut now = 2 * HEALTHY_NS;
    for generation in 2..20 {
        p.died(0, death(), now);
        p.clean_done(Ok(()), now);
        assert!(done(&mut p).contains(&Action::Spawn { service: 0, generation }));
        p.beat(0, generation, HealthState::Ready, now);
        now += HEALTHY_NS;
    }
}

/// Lets a service die `deaths` times, each time `up` after it was ready, or never ready for `None`; returns the delays in
/// ms, until it is held.
fn dies(p: &mut Policy, deaths: u32, up: Option<u64>, now: &mut u64) -> (Vec<u64>, Vec<Notice>) {
    let (mut delays, mut notices) = (Vec::new(), Vec::new());
    for _ in 0..deaths {
        let generation = p.slots()[0].generation;
        match up {
            Some(up) => {
                p.beat(0, generation, HealthState::Ready, *now);
                *now += up;
                p.beat(0, generation, HealthState::Ready, *now);
            }
            None => {
                while p.slots()[0].phase == Phase::Starting {
                    *now += 50 * MS;
                    p.heartbeats_read(*now);
                }
            }
        }
        p.died(0, death(), *now);
        p.clean_done(Ok(()), *now);
        if p.slots()[0].phase == Phase::Held {
            notices.extend(p.take().into_iter().filter_map(|a| match a {
                Action::Tell(n) => Some(n),
                _ => None,
            }));
            break;
        }
        let due = p.next_deadline();
        delays.push(due.map_or(0, |t| (t - *now) / MS));
        *now = due.unwrap_or(*now);
        p.tick(*now);
        assert_eq!(p.slots()[0].phase, Phase::Starting);
        notices.extend(p.take().into_iter().filter_map(|a| match a {
            Action::Tell(n) => Some(n),
            _ => None,
        }));
    }
    (delays, notices)
}

#[test]
fn starts_that_hang_use_up_the_budget_however_long_they_take() {
    let rule = Rule { max: 3, ..Rule::default() };
    let mut p = policy(vec![rule]);
    p.start(0);
    let mut now = 0;
    let (delays, notices) = dies(&mut p, 100, None, &mut now);
    assert_eq!(delays, [0, 50, 100]);
    assert!(now > 4 * Rule::default().start_timeout_ns);
    let last = notices.last().unwrap();
    assert_eq!(last.kind, EventKind::Held);
    assert_eq!(
        last.message,
        "it did not get ready in 4 starts in a row, which is the budget of 3 restarts: held; `dinrail restart can0` \
         starts it again"
    );
    // A start by hand has a fresh budget.
    p.restart(0, now).unwrap();
    p.died(0, death(), now);
    p.clean_done(Ok(()), now);
    assert_eq!(p.slots()[0].phase, Phase::Starting);
}

#[test]
fn one_ready_run_between_them_makes_starts_that_hang_no_row() {
    let mut p = policy(vec![Rule { max: 2, ..Rule::default() }]);
    p.start(0);
    let mut now = 0;
    for _ in 0..10 {
        assert_eq!(dies(&mut p, 2, None, &mut now).0.len(), 2);
        assert_eq!(dies(&mut p, 1, Some(11 * S), &mut now).0.len(), 1);
    }
}

#[test]
fn who_dies_seldom_but_again_and_again_waits_ever_longer_and_is_told_to_be_unstable() {
    for up in [2500 * MS, 11 * S, 59 * S] {
        let mut p = running(vec![Rule::default()]);
        let mut now = S;
        let (delays, notices) = dies(&mut p, 40, Some(up), &mut now);
        assert_eq!(delays[..9], [0, 50, 100, 200, 400, 800, 1600, 3200, 5000]);
        assert!(delays[9..].iter().all(|d| *d == 5000) && delays.len() == 40);
        let told: Vec<&Notice> = notices.iter().filter(|n| n.kind == EventKind::Unstable).collect();
        let counts: Vec<u64> = told.iter().map(|n| n.detail["deaths"].as_u64().unwrap()).collect();
        assert_eq!(counts, [5, 10, 20, 40]);
        assert!(told.iter().all(|n| n.level == Level::Fault && n.message.starts_with("unstable: died ")));
        assert!(p.slots()[0].unstable() && p.slots()[0].deaths() == 40);
        // Healthy again: told once, and the next death is a first one.
        let generation = p.slots()[0].generation;
        p.beat(0, generation, HealthState::Ready, now);
        p.beat(0, generation, HealthState::Ready, now + HEALTHY_NS - 1);
        assert!(p.slots()[0].unstable());
        now += HEALTHY_NS;
        p.take();
        p.beat(0, generation, HealthState::Ready, now);
        p.beat(0, generation, HealthState::Ready, now);
        assert_eq!(told_all(&mut p), [(EventKind::Unstable, Level::Info)]);
        assert!(!p.slots()[0].unstable());
        p.died(0, death(), now);
        p.clean_done(Ok(()), now);
        assert_eq!(p.slots()[0].phase, Phase::Starting, "at once");
    }
}

fn told_all(p: &mut Policy) -> Vec<(EventKind, Level)> {
    let tell = |a| match a {
        Action::Tell(n) => Some((n.kind, n.level)),
        _ => None,
    };
    p.take().into_iter().filter_map(tell).collect()
}

#[test]
fn a_hang_after_a_long_good_run_is_a_first_death() {
    let mut p = running(vec![Rule::default()]);
    let mut now = S;
    dies(&mut p, 4, Some(S * 3), &mut now);
    let generation = p.slots()[0].generation;
    p.beat(0, generation, HealthState::Ready, now);
    now += HEALTHY_NS;
    p.beat(0, generation, HealthState::Ready, now);
    p.heartbeats_read(now);
    for _ in 0..30 {
        now += 90 * MS;
        p.heartbeats_read(now);
    }
    assert!(matches!(p.slots()[0].phase, Phase::Aborting { .. }));
    p.died(0, death(), now);
    p.clean_done(Ok(()), now);
    assert_eq!((p.slots()[0].phase, p.slots()[0].deaths()), (Phase::Starting, 1));
}

#[test]
fn an_exhausted_budget_can_fail_the_stack() {
    let rule = Rule { max: 0, on_exhausted: Exhausted::FailStack, ..Rule::default() };
    let mut p = running(vec![rule, Rule::default()]);
    p.died(0, death(), S);
    p.clean_done(Ok(()), S);
    assert_eq!(
        done(&mut p),
        [
            Action::Clean,
            Action::CloseListeners { service: 0 },
            Action::Signal { service: 1, signal: Kill::Term }
        ]
    );
    p.died(1, death(), S);
    assert_eq!(done(&mut p), [Action::Ended]);
    assert_eq!(p.failed(), Some("service 'can0': it ended, and `restart = { max = 0 }` allows no restart"));
}

#[test]
fn silence_is_a_hang_then_sigabrt_then_sigkill() {
    let mut p = running(vec![Rule { hang_timeout_ns: S, ..Rule::default() }]);
    p.heartbeats_read(S + 10 * MS);
    assert!(p.take().is_empty());
    p.heartbeats_read(S + 11 * MS);
    assert_eq!(done(&mut p), [Action::Signal { service: 0, signal: Kill::Abort }]);
    p.heartbeats_read(S + 20 * MS);
    assert!(p.take().is_empty(), "once");
    p.tick(S + 511 * MS);
    assert_eq!(done(&mut p), [Action::Signal { service: 0, signal: Kill::Now }]);
    p.died(0, death(), S + 512 * MS);
    p.clean_done(Ok(()), S + 520 * MS);
    assert_eq!(done(&mut p), [Action::Clean, Action::Spawn { service: 0, generation: 2 }]);
}

#[test]
fn a_starting_service_may_be_silent_for_longer_and_old_generations_do_not_count() {
    let mut p = policy(vec![Rule { hang_timeout_ns: S, ..Rule::default() }]);
    p.start(0);
    p.heartbeats_read(10 * S);
    assert!(p.slots()[0].phase == Phase::Starting);
    p.beat(0, 0, HealthState::Ready, 10 * S);
    assert!(p.slots()[0].phase == Phase::Starting);
    p.take();
    p.heartbeats_read(10 * S + 1);
    assert_eq!(told(&mut p), [EventKind::Hung]);
}

#[test]
fn time_in_which_nobody_read_heartbeats_is_nobodys_silence() {
    let rule = Rule { hang_timeout_ns: S, start_timeout_ns: 3 * S, ..Rule::default() };
    let mut p = running(vec![rule.clone(), rule]);
    // One is just starting again.
    p.died(1, death(), 500 * MS);
    p.clean_done(Ok(()), 500 * MS);
    p.take();
    let mut now = 600 * MS;
    let mut turns = |p: &mut Policy, ms: u64| {
        for _ in 0..ms / 20 {
            now += 20 * MS;
            p.heartbeats_read(now);
        }
        done(p)
    };
    assert_eq!(turns(&mut p, 200), []);
    // The whole machine stood still for a minute; the launcher runs again before its services do.
    p.beat(0, 1, HealthState::Ready, 800 * MS);
    p.heartbeats_read(60 * S);
    assert_eq!(done(&mut p), []);
    now = 60 * S;
    let mut turns = |p: &mut Policy, ms: u64| {
        for _ in 0..ms / 20 {
            now += 20 * MS;
            p.heartbeats_read(now);
        }
        done(p)
    };
    // Afterwards silence counts again: 0.1 s of the pause, then every turn.
    assert_eq!(turns(&mut p, 800), []);
    assert_eq!(turns(&mut p, 200), [Action::Signal { service: 0, signal: Kill::Abort }]);
    assert_eq!(turns(&mut p, 1400), []);
    assert_eq!(turns(&mut p, 600), [Action::Signal { service: 1, signal: Kill::Abort }]);
}

#[test]
fn a_reader_that_is_always_late_still_finds_the_hang() {
    let mut p = running(vec![Rule { hang_timeout_ns: S, ..Rule::default() }]);
    let late = (1..40).find(|turn| {
        p.heartbeats_read(turn * 300 * MS);
        !done(&mut p).is_empty()
    });
    assert_eq!(late, Some(9));
}

#[test]
fn one_clean_up_serves_all_who_died_before_it_began() {
    let mut p = running(vec![Rule::default(), Rule::default(), Rule::default()]);
    p.died(0, death(), S);
    p.died(1, death(), S);
    assert_eq!(done(&mut p), [Action::Clean], "one at a time");
    p.clean_done(Ok(()), S);
    // Service 1 died while the first was on its way: it waits for the second.
    assert_eq!(done(&mut p), [Action::Clean, Action::Spawn { service: 0, generation: 2 }]);
    p.clean_done(Ok(()), S);
    assert_eq!(done(&mut p), [Action::Spawn { service: 1, generation: 2 }]);
}

#[test]
fn three_failed_clean_ups_fail_the_stack() {
    let mut p = running(vec![Rule::default(), Rule::default()]);
    p.died(0, death(), S);
    let mut now = S;
    for _ in 0..2 {
        assert_eq!(done(&mut p), [Action::Clean]);
        p.clean_done(Err("no answer within 2 s".into()), now);
        // Not at once: three helpers that cannot be started in the same moment are one failure.
        assert_eq!((done(&mut p), p.next_deadline()), (vec![], Some(now + CLEAN_PAUSE_NS)));
        now += CLEAN_PAUSE_NS;
        p.tick(now);
    }
    assert_eq!(done(&mut p), [Action::Clean]);
    p.clean_done(Err("no answer within 2 s".into()), now);
    assert_eq!(done(&mut p), [Action::Signal { service: 1, signal: Kill::Term }]);
    assert!(p.failed().is_some_and(|why| why.contains("3 times in a row (no answer within 2 s)")));
}

#[test]
fn a_failed_clean_up_is_forgotten_after_a_good_one() {
    let mut p = running(vec![Rule { max: 100, ..Rule::default() }]);
    for generation in 2..6 {
        p.died(0, death(), S);
        for _ in 0..2 {
            p.clean_done(Err("x".into()), S);
            p.tick(S + CLEAN_PAUSE_NS);
        }
        p.clean_done(Ok(()), S);
        if let Some(t) = p.next_deadline() {
            p.tick(t);
        }
        assert!(done(&mut p).contains(&Action::Spawn { service: 0, generation }));
    }
}

#[test]
fn restart_by_command_costs_no_budget_and_is_no_fault() {
    let mut p = running(vec![Rule { max: 0, ..Rule::default() }]);
    assert_eq!(p.restart(0, S), Ok(2));
    assert!(p.restart(0, S).is_err(), "not twice");
    p.tick(S + TERM_GRACE_NS);
    assert_eq!(
        done(&mut p),
        [Action::Signal { service: 0, signal: Kill::Term }, Action::Signal { service: 0, signal: Kill::Now }]
    );
    p.died(0, death(), S);
    p.clean_done(Ok(()), S);
    let all = p.take();
    assert!(all.contains(&Action::Spawn { service: 0, generation: 2 }));
    assert!(!all.iter().any(|a| matches!(a, Action::Tell(n) if n.kind == EventKind::Died)));
}

#[test]
fn who_ignores_sigterm_at_the_end_is_killed_and_a_second_stop_kills_all() {
    let mut p = running(vec![Rule::default(), Rule::default()]);
    p.stop("asked", S);
    p.tick(S + TERM_GRACE_NS);
    assert_eq!(
        done(&mut p),
        [Action::Signal { service: 1, signal: Kill::Term }, Action::Signal { service: 1, signal: Kill::Now }]
    );
    p.stop("asked", S + STOP_AGAIN_NS - 1);
    assert_eq!(done(&mut p), [], "the same wish, delivered twice");
    p.stop("asked", S + STOP_AGAIN_NS);
    assert_eq!(
        done(&mut p),
        [Action::Signal { service: 0, signal: Kill::Now }, Action::Signal { service: 1, signal: Kill::Now }]
    );
    p.died(0, death(), S);
    p.died(1, death(), S);
    assert_eq!(done(&mut p), [Action::Ended]);
}

#[test]
fn who_does_not_even_end_by_sigkill_is_told_and_the_stack_ends_without_it() {
    let mut p = running(vec![Rule::default(), Rule::default()]);
    p.heartbeats_read(S);
    for turn in 1..60 {
        p.beat(1, 1, HealthState::Ready, S + turn * 50 * MS);
        p.heartbeats_read(S + turn * 50 * MS);
    }
    let Phase::Aborting { kill_at } = p.slots()[0].phase else { panic!("{:?}", p.slots()[0].phase) };
    p.tick(kill_at);
    p.take();
    p.tick(kill_at + UNKILLABLE_NS - 1);
    assert_eq!(told_all(&mut p), []);
    assert_eq!(p.next_deadline(), Some(kill_at + UNKILLABLE_NS));
    p.tick(kill_at + UNKILLABLE_NS);
    p.tick(kill_at + 2 * UNKILLABLE_NS);
    assert_eq!(told_all(&mut p), [(EventKind::Hung, Level::Fault)], "once");
    assert_eq!((p.slots()[0].phase.word(), p.next_deadline()), ("hung", None));
    let mut now = kill_at + 3 * UNKILLABLE_NS;
    p.stop("asked", now);
    p.died(1, death(), now);
    for _ in 0..2 {
        assert!(!p.ended());
        now = p.next_deadline().unwrap();
        p.tick(now);
    }
    assert!(p.ended() && p.next_deadline().is_none());
    // It does end at last.
    p.take();
    p.died(0, death(), now);
    assert_eq!(p.take(), []);
}

#[test]
fn a_clean_up_that_only_tools_need_fails_no_stack() {
    let mut p = running(vec![Rule::default()]);
    for _ in 0..10 {
        p.housekeeping();
        assert_eq!(done(&mut p), [Action::Clean]);
        p.clean_done(Err("no answer within 2 s".into()), S);
        assert_eq!((done(&mut p), p.next_deadline()), (vec![], None));
    }
    // A service that dies meanwhile waits for the next one.
    p.housekeeping();
    p.died(0, death(), S);
    p.clean_done(Err("no answer within 2 s".into()), S);
    p.tick(S + CLEAN_PAUSE_NS);
    p.clean_done(Ok(()), S + CLEAN_PAUSE_NS);
    assert!(done(&mut p).contains(&Action::Spawn { service: 0, generation: 2 }));
}

#[test]
fn a_back_off_wakes_nobody_while_others_stop() {
    let mut p = running(vec![Rule::default(), Rule::default()]);
    for generation in 2..4 {
        p.died(0, death(), S);
        p.clean_done(Ok(()), S);
        p.beat(0, generation, HealthState::Ready, S);
    }
    let Phase::Waiting { until } = p.slots()[0].phase else { panic!("{:?}", p.slots()[0].phase) };
    p.stop("asked", S);
    p.tick(until);
    assert_eq!(p.next_deadline(), Some(S + TERM_GRACE_NS), "the other one's SIGKILL");
}

#[test]
fn a_stop_ends_back_off_and_clean_up() {
    let mut p = running(vec![Rule::default(), Rule::default()]);
    p.died(0, death(), S);
    p.died(1, death(), S);
    p.take();
    p.stop("asked", S);
    assert_eq!(done(&mut p), [Action::Ended]);
    p.clean_done(Err("late".into()), S);
    p.tick(100 * S);
    assert!(done(&mut p).is_empty());
}

proptest! {
    /// Whatever happens in whatever order: at most one process a service, one clean-up at a time, generations
    /// count up by one, and a stop always comes to its end.
    #[test]
    fn nothing_is_started_twice_and_every_stack_ends(
        events in proptest::collection::vec((0u8..8, 0usize..3, 0u64..3 * S), 0..200)
    ) {
        let rules = vec![Rule::default(), Rule { max: 2, ..Rule::default() }, Rule { recorder: true, ..Rule::default() }];
        let mut p = policy(rules);
        let mut alive = [false; 3];
        let mut generation = [0u32; 3];
        let mut killed = [false; 3];
        let mut cleaning = false;
        let mut ended = 0;
        let mut now = 0;
        p.start(now);
        let mut check = |p: &mut Policy, alive: &mut [bool; 3], cleaning: &mut bool| {
            for action in p.take() {
                match action {
                    Action::Spawn { service, generation: g } => {
                        assert!(!alive[service], "second process");
                        assert_eq!(g, generation[service] + 1);
                        generation[service] = g;
                        alive[service] = true;
                        killed[service] = false;
                    }
                    Action::Signal { service, signal } => {
                        assert!(alive[service]);
                        killed[service] |= signal == Kill::Now;
                    }
                    Action::Clean => {
                        assert!(!*cleaning, "second clean-up");
                        *cleaning = true;
                    }
                    Action::Ended => ended += 1,
                    Action::CloseListeners { .. } | Action::Tell(_) => {}
                }
            }
            assert!(ended <= 1);
        };
        check(&mut p, &mut alive, &mut cleaning);
        for (what, service, dt) in events {
            now += dt;
            match what {
                0 | 1 if alive[service] => {
                    alive[service] = false;
                    p.died(service, death(), now);
                }
                2 | 3 if cleaning => {
                    cleaning = false;
                    p.clean_done(if what == 2 { Ok(()) } else { Err("x".into()) }, now);
                }
                4 => p.beat(service, p.slots()[service].generation, HealthState::Ready, now),
                5 => p.heartbeats_read(now),
                6 => { let _ = p.restart(service, now); }
                7 => p.housekeeping(),
                _ => p.tick(now),
            }
            check(&mut p, &mut alive, &mut cleaning);
        }
        p.stop("end", now);
        check(&mut p, &mut alive, &mut cleaning);
        for _ in 0..3 {
            for service in 0..3 {
                let asked = matches!(p.slots()[service].phase, Phase::Stopping { .. } | Phase::Leaving { .. });
                if alive[service] && asked {
                    alive[service] = false;
                    p.died(service, death(), now);
                    check(&mut p, &mut alive, &mut cleaning);
                }
            }
        }
        prop_assert!(p.ended());
        // Left behind is only who did not even end by SIGKILL.
        for service in 0..3 {
            prop_assert!(!alive[service] || killed[service]);
        }
    }
}
