//! Checks that exit code and fault report match the script.

use serde_json::Value;

use super::faults::{Effect, Words};
use super::generate::Plan;
use super::judge::{Finding, Report};
use super::run::Outcome;
use super::wire::Wire;

pub fn finding(rule: &'static str, detail: String) -> Finding {
    Finding {
        rule,
        axis: "-".to_string(),
        cycle: 0,
        at: 0.0,
        detail,
        count: 1,
    }
}

fn text<'a>(value: &'a Value, path: &str) -> &'a str {
    value
        .pointer(path)
        .and_then(Value::as_str)
        .unwrap_or_default()
}

/// Extracts the user-visible texts from the result.
pub fn report(exit: i32, result: &Value, outcome: &mut Outcome) -> Report {
    outcome.error = text(result, "/error").to_string();
    outcome.headline = text(result, "/fault_report/headline").to_string();
    let none = Vec::new();
    let events = result
        .pointer("/summary/events")
        .and_then(Value::as_array)
        .unwrap_or(&none);
    let mut said = outcome.error.clone();
    for event in events
        .iter()
        .filter(|event| event["failure"] == Value::Bool(true))
    {
        said.push('\n');
        said.push_str(event["what"].as_str().unwrap_or_default());
    }
    let is_stop = |event: &&Value| {
        event["what"]
            .as_str()
            .is_some_and(|what| what.starts_with("stop"))
    };
    let stop = events.iter().find(is_stop);
    let stop_s = stop.and_then(|event| event["at_s"].as_f64());
    let failed = stop.is_some_and(|event| event["failure"] == Value::Bool(true));
    let runs = result.pointer("/summary/program_runs");
    let interrupted = result.pointer("/summary/interrupted") == Some(&Value::Bool(true));
    let completed = !interrupted && runs.and_then(Value::as_u64).is_some_and(|runs| runs > 0);
    Report {
        exit,
        text: said,
        stop_s,
        failed,
        completed,
    }
}

pub fn check(plan: &Plan, wire: &Wire, report: &Report, result: &Value, outcome: &mut Outcome) {
    let ok = result["ok"] == Value::Bool(true);
    if ok != (report.exit == 0) || result["error"].is_null() != ok {
        let detail = format!("exit {}, ok {ok}, error {}", report.exit, result["error"]);
        outcome.findings.push(finding("result", detail));
    }
    let stopped_at = report.stop_s.and_then(|seconds| {
        let first = wire.cycles.first()?;
        Some(first.at as f64 * 1e-9 + seconds)
    });
    // The cause of a regular end does not explain a failure; a later fault may.
    let until = stopped_at.filter(|_| report.failed).unwrap_or(wire.seconds);
    let until = until + 2.0 * plan.machine.seconds();
    let struck: Vec<_> = plan
        .faults
        .iter()
        .filter(|fault| fault.at <= until)
        .collect();
    let said = outcome.error.clone();
    if report.exit == 0 {
        if !report.text.is_empty() {
            let detail = format!("exit 0, and {}", report.text.trim());
            outcome
                .findings
                .push(finding("exit-0-with-failure", detail));
        }
        // The fault occurred while the drive was powered, and long before the end of the run.
        let sure = |effect: Effect| effect == Effect::Failure;
        if let Some(fault) = plan
            .faults
            .iter()
            .find(|fault| sure(fault.effect) && fault.at < plan.ends_at)
        {
            let detail = format!("{} at {:.3} s, and exit 0", fault.kind, fault.at);
            outcome
                .findings
                .push(finding("fault-without-failure", detail));
        }
        return;
    }
    if plan.may_fail {
        return;
    }
    if plan.faults.iter().all(|fault| fault.effect == Effect::None) {
        let kinds: Vec<&str> = plan.faults.iter().map(|fault| fault.kind).collect();
        let detail = format!(
            "{kinds:?} are no reason to fail: {said} ({})",
            outcome.headline
        );
        outcome
            .findings
            .push(finding("failure-without-reason", detail));
        return;
    }
    let cause = result
        .pointer("/fault_report/cause/cause")
        .or_else(|| result.pointer("/fault_report/cause"))
        .and_then(Value::as_str)
        .unwrap_or_default();
    let first = if outcome.headline.is_empty() {
        &outcome.error
    } else {
        &outcome.headline
    };
    let words = Words {
        text: format!("{first}\n{said}"),
        cause: cause.to_string(),
    };
    outcome.right = Some(struck.iter().any(|fault| fault.explains(&words)));
}
