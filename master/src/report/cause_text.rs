//! Texts of causes.

use ecaxis_axis::EnableBlocker;
use ecaxis_axis::cia402::describe;

use crate::config::UnitProblem;
use crate::text::pluralize;

pub(super) fn list(problems: &[UnitProblem]) -> String {
    let each: Vec<String> = problems.iter().map(ToString::to_string).collect();
    each.join("; ")
}

pub(super) fn al_note(al_status: Option<(u8, u16)>) -> String {
    match al_status {
        Some((status, count)) => {
            let answer = if count == 1 { "answers" } else { "answer" };
            format!(
                "the working counter is wrong; {} {answer}, AL status 0x{status:02x}",
                pluralize(usize::from(count), "SubDevice")
            )
        }
        None => "cyclic frames do not return in time".to_owned(),
    }
}

/// Names what an axis waits for, if the Statusword does not show it.
pub(super) fn blocker_note(waiting: Option<EnableBlocker>) -> String {
    match waiting {
        Some(
            blocker @ (EnableBlocker::Mode { .. }
            | EnableBlocker::Follows { .. }
            | EnableBlocker::Position),
        ) => format!(", {blocker}"),
        _ => String::new(),
    }
}

pub(super) fn code_note(code: Option<u16>) -> String {
    match code {
        Some(code) => format!(
            ", error code (0x603F) 0x{code:04x}: {}",
            describe(code).text
        ),
        None => String::new(),
    }
}

pub(super) fn lost(group: Option<&str>) -> String {
    match group {
        Some(group) => format!("the process data of the group `{group}` is lost"),
        None => "the bus is lost".to_owned(),
    }
}

pub(super) fn lost_note(answered: bool, (seen, expected): (u16, u16)) -> String {
    if answered {
        format!("with working counter {seen} instead of {expected}")
    } else {
        "without an answer".to_owned()
    }
}

/// Returns the homing method in words.
pub(super) fn by(method: i8) -> String {
    match ecaxis_axis::homing::method(method) {
        Some(known) => format!("method {method} ({})", known.text),
        None => format!("method {method}"),
    }
}
