//! What can be found wrong with the key `trigger` without starting.

use crate::config::{Config, EventTrigger, Trigger, TriggerWord};
use dinrail_iec::artifact::Task;
use ipc_types::stack::{Finding, ServiceEntry, Stack};
use ipc_types::units::Span;
use serde::Deserialize;

/// As the stack file writes it.
pub(super) fn text(trigger: &Trigger) -> String {
    match trigger {
        Trigger::Word(TriggerWord::Cycle) => "\"cycle\"".to_owned(),
        Trigger::Word(TriggerWord::Inputs) => "\"inputs\"".to_owned(),
        Trigger::Event(EventTrigger { service, event }) => {
            format!("{{ service = \"{service}\", event = \"{}\" }}", event.word())
        }
    }
}

/// The named service has the event, its inputs are this plc's, and the intervals suit its period.
pub(super) fn check(config: &Config, stack: &Stack, me: &str, findings: &mut Vec<Finding>) {
    let Some(wanted) = config.trigger.event() else { return };
    let word = wanted.event.word();
    let mine = |s: &&ServiceEntry| s.wiring.plc.as_deref() == Some(me);
    let able: Vec<&str> = stack
        .services
        .iter()
        .filter(mine)
        .filter(|s| s.wiring.events.contains(&wanted.event))
        .map(|s| s.name.as_str())
        .collect();
    let choose = if able.is_empty() {
        "only a canopen-master with sync_period and synchronous inputs has it; take trigger = \"inputs\" for others"
            .to_owned()
    } else {
        format!("write service = \"{}\"", able.join("\" or \""))
    };
    let key = "trigger.service";
    let Some(service) = stack.service(&wanted.service) else {
        let message = format!("there is no service '{}'", wanted.service);
        findings.push(Finding::error(me, key, message, choose));
        return;
    };
    if !mine(&service) {
        let (message, help) = match &service.wiring.plc {
            // It lacks the key `plc`, which is told at its own table.
            None if service.wiring.events.contains(&wanted.event) => return,
            Some(other) => (
                format!("the inputs of '{}' go to '{other}', not to '{me}'", service.name),
                format!("move the trigger to '{other}', or set plc = \"{me}\" in '{}'", service.name),
            ),
            None => (no_event(service, word), choose),
        };
        findings.push(Finding::error(me, key, message, help));
        return;
    }
    if !service.wiring.events.contains(&wanted.event) {
        let (message, help) = lacking(service, word, choose);
        findings.push(Finding::error(me, key, message, help));
        return;
    }
    check_period(config, service, me, findings);
}

fn no_event(service: &ServiceEntry, word: &str) -> String {
    format!("'{}' is a {} service, which has no event \"{word}\"", service.name, service.kind)
}

/// Why a service of this plc has no such event.
fn lacking(service: &ServiceEntry, word: &str, choose: String) -> (String, String) {
    let name = &service.name;
    if service.kind != "canopen-master" {
        return (no_event(service, word), choose);
    }
    if period(service).is_none() {
        let help = format!("set sync_period = \"10ms\" in service '{name}'");
        return (format!("'{name}' sends no SYNC: it has no sync_period"), help);
    }
    let help = format!(
        "map an object to %I whose TPDO is synchronous: tpdo = [{{ number = 1, transmission = 1 }}] at the node of '{name}'"
    );
    (format!("'{name}' has no synchronous inputs, so that it publishes no sample at a SYNC"), help)
}

fn period(service: &ServiceEntry) -> Option<Span> {
    service.config.get("sync_period").and_then(|value| Span::deserialize(value).ok()).filter(|p| p.ns() > 0)
}

fn check_period(config: &Config, service: &ServiceEntry, me: &str, findings: &mut Vec<Finding>) {
    let Some(period) = period(service) else { return };
    let name = &service.name;
    if config.max_interval <= period {
        let message = format!(
            "max_interval = {} is not longer than the sync_period of '{name}', {period}: the task runs without SYNC too",
            config.max_interval
        );
        let help = "set max_interval to three times the sync_period, at most \"1s\"";
        findings.push(Finding::warning(me, "max_interval", message, help));
    }
    if config.min_interval > period {
        let message = format!(
            "min_interval = {} is longer than the sync_period of '{name}', {period}: samples are skipped",
            config.min_interval
        );
        findings.push(Finding::warning(me, "min_interval", message, "make it shorter than the sync_period"));
    }
}

/// A program in which nothing waits for the event.
pub(super) fn check_tasks(config: &Config, tasks: &[Task], me: &str, findings: &mut Vec<Finding>) {
    // With `cycle`, which excludes the trigger and is told there, the implicit task is cyclic.
    if config.trigger.event().is_some()
        && config.cycle.is_none()
        && !tasks.iter().any(|t| t.interval_ns.is_none() && t.single.is_none())
    {
        let message = format!(
            "trigger = {} triggers nothing: every TASK of the program has INTERVAL or SINGLE",
            text(&config.trigger)
        );
        let help = "leave one PROGRAM without TASK, or leave INTERVAL and SINGLE out of one TASK";
        findings.push(Finding::error(me, "trigger", message, help));
    }
}
