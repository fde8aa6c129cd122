//! A table of the axes that is rewritten while a machine runs.

use anstyle::{AnsiColor, Style};
use ecaxis_axis::{Mode, State};
use ecaxis_master::session::{AxisLine, Status};
use ecaxis_master::text::positive_zero;

use crate::render::style;

const PLAIN: Style = Style::new();
const FAINT: Style = Style::new().dimmed();
const GOOD: Style = AnsiColor::Green.on_default();
const BUSY: Style = AnsiColor::Yellow.on_default();
const BAD: Style = AnsiColor::Red.on_default().bold();

/// The most decimals of a value.
const DECIMALS: f64 = 4.0;

/// The size of the values so far, from which the decimals follow: they do not change with each
/// value.
#[derive(Debug, Default)]
pub(crate) struct Live {
    /// For each axis: the largest value, following error and torque.
    largest: Vec<[f64; 3]>,
}

/// The value that an axis controls, with its unit.
struct Controlled {
    target: f64,
    actual: f64,
    unit: String,
}

impl Controlled {
    fn of(axis: &AxisLine) -> Self {
        let (target, actual, unit) = match axis.mode {
            Mode::Csv | Mode::Pv => {
                let unit = format!("{}/s", axis.unit);
                (axis.target_velocity, axis.velocity, unit)
            }
            Mode::Cst => {
                let unit = axis.torque_unit.to_string();
                (axis.target_torque, axis.torque, unit)
            }
            _ => (axis.target_position, axis.position, axis.unit.clone()),
        };
        Self {
            target,
            actual,
            unit,
        }
    }
}

impl Live {
    /// Returns the lines of the table, at most `rows`, each at most `columns` wide.
    pub fn lines(&mut self, status: &Status, [columns, rows]: [usize; 2]) -> Vec<String> {
        self.largest.resize(status.axes.len(), [0.0; 3]);
        let mut lines = vec![styled(FAINT, &head(columns))];
        // The last line says how many axes do not fit.
        let room = rows.saturating_sub(2).max(1);
        for (axis, largest) in status.axes.iter().zip(&mut self.largest) {
            lines.push(line(axis, largest, columns));
            if let Some(trouble) = &axis.trouble {
                let text = clipped(&format!("    {trouble}"), columns);
                lines.push(styled(colour(axis), &text));
            }
        }
        if lines.len() > room + 1 {
            lines.truncate(room + 1);
            lines.push(styled(FAINT, &clipped("… more axes do not fit", columns)));
        }
        lines
    }
}

/// The columns of all values.
const WIDE: usize = 76;

fn head(columns: usize) -> String {
    let (axis, state, actual) = ("axis", "state", "actual");
    if columns < WIDE {
        return clipped(&format!("{axis:<10}{state:<15}{actual:>9}"), columns);
    }
    format!(
        "{axis:<10}{state:<20}{:>10}{actual:>10} {:<6}{:>9}{:>10}",
        "target", "unit", "error", "torque"
    )
}

fn line(axis: &AxisLine, largest: &mut [f64; 3], columns: usize) -> String {
    let Controlled {
        target,
        actual,
        unit,
    } = Controlled::of(axis);
    let now = [
        target.abs().max(actual.abs()),
        axis.following_error.abs(),
        axis.torque.abs(),
    ];
    for (largest, now) in largest.iter_mut().zip(now) {
        // NaN, an unknown value, counts as nothing.
        *largest = largest.max(now);
    }
    let value = |value, column: usize| figure(value, largest[column]);
    let name = format!("{:<10}", clipped(&axis.name, 9));
    let state = axis.state.to_string();
    let state = |width: usize| {
        let text = clipped(&state, width - 1);
        styled(colour(axis), &format!("{text:<width$}"))
    };
    if columns < WIDE {
        let room = columns.saturating_sub(25);
        let actual = clipped(&format!("{:>9} {unit}", value(actual, 0)), room);
        return format!("{name}{}{actual}", state(15));
    }
    let error = match axis.mode {
        Mode::Csp => value(axis.following_error, 1),
        _ => String::new(),
    };
    let torque = format!("{} {}", value(axis.torque, 2), axis.torque_unit);
    format!(
        "{name}{}{:>10}{:>10} {:<6}{error:>9}{torque:>10}",
        state(20),
        value(target, 0),
        value(actual, 0),
        clipped(&unit, 6),
    )
}

fn colour(axis: &AxisLine) -> Style {
    match axis.state {
        State::Fault | State::FaultReactionActive => BAD,
        State::OperationEnabled if axis.trouble.is_some() => BAD,
        State::OperationEnabled => GOOD,
        _ if axis.trouble.is_some() => BUSY,
        _ => PLAIN,
    }
}

/// Returns a number with three significant digits at the size of the largest.
fn figure(value: f64, largest: f64) -> String {
    if !value.is_finite() {
        return "–".to_owned();
    }
    // 1 to 9.99 have two decimals.
    let digits = largest.log10().floor();
    let decimals = match digits.is_finite() {
        true => (2.0 - digits).clamp(0.0, DECIMALS),
        false => 1.0,
    };
    let value = positive_zero(value, decimals as i32);
    format!("{value:.*}", decimals as usize)
}

/// Cuts a text that is too long.
pub(crate) fn clipped(text: &str, most: usize) -> String {
    if text.chars().count() <= most {
        return text.to_owned();
    }
    let mut clipped: String = text.chars().take(most.saturating_sub(1)).collect();
    clipped.extend((most > 0).then_some('…'));
    clipped
}

fn styled(colour: Style, text: &str) -> String {
    match style::on_stderr() {
        true => format!("{colour}{text}{colour:#}"),
        false => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use ecaxis_master::config::TorqueUnit;
    use ecaxis_master::rt::stats::Counters;

    use super::*;

    fn axis(name: &str, mode: Mode) -> AxisLine {
        AxisLine {
            name: name.to_owned(),
            unit: "mm".to_owned(),
            mode,
            state: State::OperationEnabled,
            position: 49.98,
            velocity: 12.3456,
            torque: -3.21,
            torque_unit: TorqueUnit::Percent,
            target_position: 50.0,
            target_velocity: 12.5,
            target_torque: 4.0,
            following_error: 0.0213,
            trouble: None,
        }
    }

    fn shown(axes: Vec<AxisLine>, size: [usize; 2]) -> Vec<String> {
        let status = Status {
            time: 0,
            counters: Counters::default(),
            phase: None,
            axes,
        };
        let lines = Live::default().lines(&status, size);
        // Colours are off: stderr is not a terminal, or carries none.
        let plain = |line: String| anstream::adapter::strip_str(&line).to_string();
        lines.into_iter().map(plain).collect()
    }

    #[test]
    fn columns_depend_on_the_width() {
        let axes = || {
            vec![
                axis("x", Mode::Csp),
                axis("spindle", Mode::Csv),
                axis("w", Mode::Cst),
            ]
        };
        assert_eq!(
            shown(axes(), [80, 20]),
            [
                "axis      state                   target    actual unit      error    torque",
                "x         Operation enabled         50.0      50.0 mm       0.0213   -3.21 %",
                "spindle   Operation enabled         12.5      12.3 mm/s              -3.21 %",
                "w         Operation enabled         4.00     -3.21 %                 -3.21 %",
            ]
        );
        assert_eq!(
            shown(axes(), [40, 20])[1],
            "x         Operation ena…      50.0 mm"
        );
        for columns in 1..130 {
            for line in shown(axes(), [columns, 20]) {
                assert!(
                    columns < 40 || line.chars().count() <= columns,
                    "{columns}: {line}"
                );
            }
        }
    }

    #[test]
    fn faults_have_a_line_and_axes_that_do_not_fit_are_announced() {
        let mut broken = axis("x", Mode::Csp);
        broken.trouble = Some("drive fault 0x3210: DC link overvoltage".to_owned());
        broken.state = State::Fault;
        let lines = shown(vec![broken, axis("y", Mode::Csp)], [80, 20]);
        assert_eq!(lines[2], "    drive fault 0x3210: DC link overvoltage");
        let many = (0..9).map(|n| axis(&n.to_string(), Mode::Csp)).collect();
        let lines = shown(many, [80, 6]);
        assert_eq!(lines.len(), 6);
        assert_eq!(lines[5], "… more axes do not fit");
    }

    #[test]
    fn figures_have_three_digits_at_the_size_of_the_largest() {
        for (value, largest, text) in [
            (0.0, 0.0, "0.0"),
            (1.0, 1234.5, "1"),
            (12.34, 50.0, "12.3"),
            (-0.001, 9.0, "0.00"),
            (0.000_123, 0.000_5, "0.0001"),
            (f64::NAN, 1.0, "–"),
        ] {
            assert_eq!(figure(value, largest), text);
        }
    }
}
