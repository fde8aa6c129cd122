//! Keys → what is asked for. Knows no terminal and no clock.

use ecaxis::supervise::manual::{Doing, LET_GO, MOST_SPEED, Request};

use super::keys::Key;
use super::panel::{AxisPanel, Panel};

/// Fractions of the velocity limit, and which of them comes first.
const SPEEDS: [f64; 7] = [0.01, 0.02, 0.05, 0.1, 0.15, 0.2, MOST_SPEED];
const FIRST_SPEED: usize = 2;
/// A key that is held down begins to repeat within this time, milliseconds.
const REPEATS_WITHIN: u64 = 1_000;
/// Longest number that is typed.
const LONGEST: usize = 16;

/// What the keyboard's end asks of the machine's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Ask {
    /// Somebody is there.
    Alive,
    For(Request),
    Leave,
}

/// A key that jogs.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Held {
    key: Key,
    /// When it last came, milliseconds.
    at: u64,
    repeats: bool,
}

#[derive(Debug)]
pub(super) struct Ui {
    pub selected: usize,
    speed: usize,
    /// Powers of ten that the step is larger than at first.
    decades: i32,
    /// What has been typed of a position.
    pub typed: Option<String>,
    held: Option<Held>,
}

impl Default for Ui {
    fn default() -> Self {
        Self {
            selected: 0,
            speed: FIRST_SPEED,
            decades: 0,
            typed: None,
            held: None,
        }
    }
}

impl Ui {
    /// Fraction of the velocity limit.
    pub fn speed(&self) -> f64 {
        SPEEDS.get(self.speed).copied().unwrap_or(SPEEDS[0])
    }

    /// User units: a power of ten, at first about a hundredth of the axis' range, or what it travels at full
    /// speed in a tenth of a second.
    pub fn step(&self, axis: &AxisPanel) -> f64 {
        let way = match axis.limits.position {
            Some([low, high]) => (high - low) * 0.01,
            None => axis.limits.velocity * 0.1,
        };
        let first = way.max(1e-6).log10().floor();
        10_f64.powf(first + f64::from(self.decades))
    }

    /// A key for moving has come once; held down it moves.
    pub fn armed(&self, now: u64) -> bool {
        self.held
            .is_some_and(|held| !held.repeats && now.saturating_sub(held.at) < REPEATS_WITHIN)
    }

    /// `now`: milliseconds.
    pub fn key(&mut self, key: Key, now: u64, panel: Option<&Panel>) -> Vec<Ask> {
        let stop_all = || vec![Ask::For(Request::StopAll)];
        if matches!(key, Key::FocusGained) {
            return Vec::new();
        }
        let (leave, typing) = (key == Key::Leave, self.typed.is_some());
        if leave || (key == Key::Char('q') && !typing) {
            return vec![Ask::Leave];
        }
        let Some((panel, axis)) = panel.and_then(|p| Some((p, p.axes.get(self.selected)?))) else {
            return Vec::new();
        };
        let selected = self.selected;
        // Whatever is being typed.
        if key == Key::Char('x') {
            (self.typed, self.held) = (None, None);
            return vec![Ask::For(Request::EmergencyStop)];
        }
        if let Some(typed) = &mut self.typed {
            match key {
                Key::Char(c @ ('0'..='9' | '.' | '-' | '+')) => {
                    if typed.len() < LONGEST {
                        typed.push(c);
                    }
                }
                Key::Backspace => {
                    typed.pop();
                }
                Key::Enter => {
                    let position = self.typed.take().and_then(|typed| typed.parse().ok());
                    let speed = self.speed();
                    return match position {
                        Some(position) => vec![Ask::For(Request::MoveTo {
                            axis: selected,
                            position,
                            speed,
                        })],
                        None => Vec::new(),
                    };
                }
                _ => {
                    self.typed = None;
                    return stop_all();
                }
            }
            return Vec::new();
        }
        if matches!(key, Key::Left | Key::Right) {
            let sign = if key == Key::Left { -1.0 } else { 1.0 };
            let velocity = sign * self.speed() * axis.limits.velocity;
            return match self.hold(key, now) {
                true => vec![Ask::For(Request::Jog {
                    axis: selected,
                    velocity,
                })],
                false => Vec::new(),
            };
        }
        self.held = None;
        let all = |request: fn(usize) -> Request| {
            (0..panel.axes.len())
                .map(|axis| Ask::For(request(axis)))
                .collect()
        };
        let enable = |axis| Request::Enable { axis };
        let disable = |axis| Request::Disable { axis };
        let axis_request = match key {
            Key::Up => {
                self.selected = selected.saturating_sub(1);
                return stop_if_moving(panel);
            }
            Key::Down => {
                self.selected = (selected + 1) % panel.axes.len().max(1);
                return stop_if_moving(panel);
            }
            Key::Char('-') => {
                self.speed = self.speed.saturating_sub(1);
                return Vec::new();
            }
            Key::Char('+' | '=') => {
                self.speed = (self.speed + 1).min(SPEEDS.len() - 1);
                return Vec::new();
            }
            Key::Char('[') => {
                self.decades = (self.decades - 1).max(-4);
                return Vec::new();
            }
            Key::Char(']') => {
                self.decades = (self.decades + 1).min(2);
                return Vec::new();
            }
            Key::Char('m') => {
                self.typed = Some(String::new());
                return Vec::new();
            }
            Key::Char('E') => return all(enable),
            Key::Char('D') => return all(disable),
            Key::Char('e') => enable(selected),
            Key::Char('d') => disable(selected),
            Key::Char('h') => Request::Home { axis: selected },
            Key::Char('r') => Request::Reset { axis: selected },
            Key::Char('o') => {
                let at = axis.modes.iter().position(|mode| *mode == axis.mode);
                let next = at.map_or(0, |at| (at + 1) % axis.modes.len());
                match axis.modes.get(next) {
                    Some(&mode) if mode != axis.mode => Request::SetMode {
                        axis: selected,
                        mode,
                    },
                    _ => return Vec::new(),
                }
            }
            Key::Char(c @ (',' | '.')) => Request::MoveBy {
                axis: selected,
                distance: if c == ',' { -1.0 } else { 1.0 } * self.step(axis),
                speed: self.speed(),
            },
            // Space, Escape, the focus is elsewhere, or a slip of the hand.
            _ => return stop_all(),
        };
        vec![Ask::For(axis_request)]
    }

    /// Whether the key is being held down: it has come before, and soon enough.
    fn hold(&mut self, key: Key, now: u64) -> bool {
        let before = self.held.filter(|held| held.key == key);
        let repeats = before.is_some_and(|held| {
            let within = if held.repeats {
                LET_GO / 1_000_000
            } else {
                REPEATS_WITHIN
            };
            now.saturating_sub(held.at) <= within
        });
        self.held = Some(Held {
            key,
            at: now,
            repeats,
        });
        repeats
    }
}

/// Who looks at another axis sees no longer what the first one does.
fn stop_if_moving(panel: &Panel) -> Vec<Ask> {
    let jogs = |axis: &AxisPanel| matches!(axis.doing, Doing::Jogging { .. });
    let jogging = panel.axes.iter().enumerate().filter(|(_, axis)| jogs(axis));
    jogging
        .map(|(axis, _)| Ask::For(Request::Stop { axis }))
        .collect()
}

#[cfg(test)]
#[path = "ui_tests.rs"]
mod tests;
