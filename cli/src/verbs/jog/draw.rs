//! Panel, messages and keys → rows. 80 × 24 is sufficient; rows that do not fit are cut at the end.

use anstyle::{AnsiColor, Style};
use ecaxis_axis::State;
use ecaxis_master::text::positive_zero;

use super::panel::{AxisPanel, Messages, Panel, number};
use super::ui::Ui;

const PLAIN: Style = Style::new();
const HEAD: Style = Style::new().bold();
const GOOD: Style = AnsiColor::Green.on_default();
const BAD: Style = AnsiColor::Red.on_default().bold();
const FAINT: Style = Style::new().dimmed();

/// The smallest terminal that shows an axis and the keys.
const SMALLEST: (usize, usize) = (60, 16);
const KEYS: [&str; 4] = [
    "hold ←/→ jog   , . step   [ ] step size   - + speed   m move to   h home",
    "↑/↓ axis   e/d enable/disable   E/D all   o mode   r reset   q quit",
    "space, Esc or any other key: all axes brake",
    "x: EMERGENCY STOP, the shortest way to no motion and no power",
];

/// The inputs of a drawing.
#[derive(Debug, Clone, Copy)]
pub(super) struct Screen<'p> {
    /// The names of machine file and bus.
    pub title: &'p str,
    pub panel: Option<&'p Panel>,
    pub messages: &'p Messages,
    pub ui: &'p Ui,
    /// The time in ms on the clock of the keys.
    pub now: u64,
    /// Columns and rows.
    pub size: (usize, usize),
    pub colours: bool,
}

/// Pieces of text, each with its style.
type Row = Vec<(Style, String)>;

impl Screen<'_> {
    pub fn rows(&self) -> Vec<String> {
        let (columns, rows) = self.size;
        if columns < SMALLEST.0 || rows < SMALLEST.1 {
            let (wide, high) = SMALLEST;
            let text = format!("the terminal is smaller than {wide}x{high}; any key: stop");
            return vec![self.shown(&vec![(BAD, text)])];
        }
        let mut all = self.head();
        let tail = self.tail();
        if let Some(panel) = self.panel {
            let room = rows.saturating_sub(all.len() + tail.len() + 8);
            all.extend(self.axes(panel, room.max(1)));
            all.push(Row::new());
            if let Some(axis) = panel.axes.get(self.ui.selected) {
                all.extend(self.selected(axis));
            }
        }
        all.push(Row::new());
        let room = rows.saturating_sub(all.len() + tail.len());
        let messages: Vec<Row> = self.messages.last(room).map(message).collect();
        let gap = room - messages.len();
        all.extend(messages);
        all.extend(std::iter::repeat_n(Row::new(), gap));
        all.extend(tail);
        all.truncate(rows);
        all.iter().map(|row| self.shown(row)).collect()
    }

    fn head(&self) -> Vec<Row> {
        let mut row = vec![(HEAD, format!(" {}", self.title))];
        if let Some(panel) = self.panel {
            let Panel {
                time_s,
                lost_frames,
                wkc_errors,
                ..
            } = panel;
            let lost = *lost_frames + *wkc_errors;
            let style = if lost > 0 { BAD } else { PLAIN };
            row.push((PLAIN, format!("  {time_s:.1} s")));
            row.push((style, format!("  lost {lost_frames}  wkc {wkc_errors}")));
            match panel.locked {
                Some(true) => row.push((PLAIN, "  in phase".to_owned())),
                Some(false) => row.push((BAD, "  phase lost".to_owned())),
                None => {}
            }
        }
        vec![row, Row::new()]
    }

    fn axes(&self, panel: &Panel, room: usize) -> Vec<Row> {
        let head = format!(
            "   {:<9}{:<23}{:<5}{:>12}{:>11}{:>9}",
            "axis", "state", "mode", "position", "velocity", "torque"
        );
        // The selected axis is always visible.
        let first = (self.ui.selected.0 + 1).saturating_sub(room);
        let shown = panel.axes.enumerate().skip(first).take(room);
        let mut rows = vec![vec![(FAINT, head)]];
        rows.extend(shown.map(|(index, axis)| {
            let chosen = index == self.ui.selected;
            let mark = if chosen { " > " } else { "   " };
            let style = match axis.state {
                _ if axis.trouble.is_some() => BAD,
                State::OperationEnabled => GOOD,
                State::Fault | State::FaultReactionActive => BAD,
                _ => PLAIN,
            };
            let name = if chosen { HEAD } else { PLAIN };
            let state = axis.state.to_string();
            vec![
                (name, format!("{mark}{:<8} ", clipped(&axis.name, 8))),
                (style, format!("{:<22} ", clipped(&state, 22))),
                (PLAIN, format!("{:<5}", axis.mode.to_string())),
                (
                    PLAIN,
                    format!(
                        "{:>12.3}{:>11.3}{:>9.2}",
                        positive_zero(axis.position, 3),
                        positive_zero(axis.velocity, 3),
                        positive_zero(axis.torque, 2)
                    ),
                ),
            ]
        }));
        rows
    }

    fn selected(&self, axis: &AxisPanel) -> Vec<Row> {
        let unit = &axis.unit;
        let limits = axis.limits;
        let homed = if axis.homed { "  homed" } else { "" };
        let mut rows = vec![vec![
            (HEAD, format!(" {} {}", axis.name, axis.doing())),
            (
                PLAIN,
                format!(
                    "  target {} {unit}  following error {:.4} {unit}{homed}",
                    number(axis.target),
                    positive_zero(axis.following_error, 4),
                ),
            ),
        ]];
        let range = match limits.position {
            Some([low, high]) => format!("{} … {} {unit}", number(low), number(high)),
            None => "endless".to_owned(),
        };
        let error = limits.following_error.map(number);
        let error = error.map_or(String::new(), |e| format!(", following error {e} {unit}"));
        let (velocity, torque) = (number(limits.velocity), number(limits.torque));
        let torque_unit = axis.torque_unit;
        rows.push(vec![(
            PLAIN,
            format!(" limits  {range}, {velocity} {unit}/s, {torque} {torque_unit}{error}"),
        )]);
        let speed = self.ui.speed();
        let step = number(self.ui.step(axis));
        rows.push(vec![(
            PLAIN,
            format!(
                " speed   {} % = {} {unit}/s   step {step} {unit}",
                number(speed * 100.0),
                number(speed * axis.limits.velocity)
            ),
        )]);
        let trouble = axis.trouble.as_deref().unwrap_or_default();
        rows.push(match &self.ui.typed {
            Some(typed) => vec![(
                HEAD,
                format!(
                    " move {} to {typed}_ {unit}   Enter: go, Esc: no",
                    axis.name
                ),
            )],
            None if !trouble.is_empty() => vec![(BAD, format!(" {trouble}"))],
            None if self.ui.armed(self.now) => vec![(HEAD, " keep holding …".to_owned())],
            None => Row::new(),
        });
        rows
    }

    fn tail(&self) -> Vec<Row> {
        let mut rows = vec![Row::new()];
        rows.extend(KEYS.map(|keys| vec![(FAINT, format!(" {keys}"))]));
        rows
    }

    /// Formats a row within the terminal's width. Control characters are removed.
    fn shown(&self, row: &Row) -> String {
        let mut room = self.size.0;
        let mut text = String::new();
        for (style, piece) in row {
            let mut piece = clipped(piece, room);
            room -= piece.chars().count();
            if piece.contains(char::is_control) {
                piece = piece.replace(char::is_control, "?");
            }
            if self.colours && *style != PLAIN {
                text += &format!("{style}{piece}{style:#}");
            } else {
                text += &piece;
            }
        }
        text
    }
}

fn message(message: &super::panel::Message) -> Row {
    let style = if message.bad { BAD } else { PLAIN };
    let times = match message.times {
        0 | 1 => String::new(),
        n => format!("  ({n} times)"),
    };
    vec![(style, format!(" {}{times}", message.text))]
}

fn clipped(text: &str, most: usize) -> String {
    if text.chars().count() <= most {
        return text.to_owned();
    }
    let mut clipped: String = text.chars().take(most.saturating_sub(1)).collect();
    clipped.extend((most > 0).then_some('…'));
    clipped
}

#[cfg(test)]
#[path = "draw_tests.rs"]
mod tests;
