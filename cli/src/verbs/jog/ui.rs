//! Keys → requests. Independent of terminal and clock.

use ecaxis_ecat::index::AxisIndex;
use ecaxis_master::supervise::operator::{
    Activity, HOLD_TO_RUN_TIMEOUT, MAX_MANUAL_SPEED, Request,
};

use super::keys::Key;
use super::panel::{AxisPanel, Panel};

/// The fractions of the velocity limit; the default follows.
const SPEEDS: [f64; 7] = [0.01, 0.02, 0.05, 0.1, 0.15, 0.2, MAX_MANUAL_SPEED];
const FIRST_SPEED: usize = 2;
/// The maximum delay in ms before a held key repeats.
const REPEATS_WITHIN: u64 = 1_000;
/// The maximum length of a typed number.
const LONGEST: usize = 16;

/// Requests of the terminal's side to the machine's side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum UiAction {
    /// A sign of life.
    Alive,
    For(Request),
    Leave,
}

/// A held key that jogs.
#[derive(Debug, Clone, Copy, PartialEq)]
struct HeldKey {
    key: Key,
    /// The time of its last occurrence in ms.
    at: u64,
    repeats: bool,
}

#[derive(Debug)]
pub(super) struct Ui {
    pub selected: AxisIndex,
    speed: usize,
    /// The power of ten by which the user enlarged the step.
    decades: i32,
    /// The typed part of a position.
    pub typed: Option<String>,
    held: Option<HeldKey>,
}

impl Default for Ui {
    fn default() -> Self {
        Self {
            selected: AxisIndex(0),
            speed: FIRST_SPEED,
            decades: 0,
            typed: None,
            held: None,
        }
    }
}

impl Ui {
    /// The fraction of the velocity limit.
    pub fn speed(&self) -> f64 {
        SPEEDS.get(self.speed).copied().unwrap_or(SPEEDS[0])
    }

    /// The step in user units: a power of ten. The default is about 1 % of the axis' range, or the
    /// travel in 0.1 s at full speed.
    pub fn step(&self, axis: &AxisPanel) -> f64 {
        let way = match axis.limits.position {
            Some([low, high]) => (high - low) * 0.01,
            None => axis.limits.velocity * 0.1,
        };
        let first = way.max(1e-6).log10().floor();
        10_f64.powf(first + f64::from(self.decades))
    }

    /// True if a motion key came once; it moves when it repeats.
    pub fn armed(&self, now: u64) -> bool {
        self.held
            .is_some_and(|held| !held.repeats && now.saturating_sub(held.at) < REPEATS_WITHIN)
    }

    /// Handles a key. `now` is in ms.
    pub fn key(&mut self, key: Key, now: u64, panel: Option<&Panel>) -> Vec<UiAction> {
        let stop_all = || vec![UiAction::For(Request::StopAll)];
        if matches!(key, Key::FocusGained) {
            return Vec::new();
        }
        let (leave, typing) = (key == Key::Leave, self.typed.is_some());
        if leave || (key == Key::Char('q') && !typing) {
            return vec![UiAction::Leave];
        }
        let Some((panel, axis)) = panel.and_then(|p| Some((p, p.axes.get(self.selected)?))) else {
            return Vec::new();
        };
        let selected = self.selected;
        // The emergency stop works during number input as well.
        if key == Key::Char('x') {
            (self.typed, self.held) = (None, None);
            return vec![UiAction::For(Request::EmergencyStop)];
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
                        Some(position) => vec![UiAction::For(Request::MoveTo {
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
                true => vec![UiAction::For(Request::Jog {
                    axis: selected,
                    velocity,
                })],
                false => Vec::new(),
            };
        }
        self.held = None;
        let all = |request: fn(AxisIndex) -> Request| {
            let axes = panel.axes.indices();
            axes.map(|axis| UiAction::For(request(axis))).collect()
        };
        let enable = |axis| Request::Enable { axis };
        let disable = |axis| Request::Disable { axis };
        let axis_request = match key {
            Key::Up => {
                self.selected = AxisIndex(selected.0.saturating_sub(1));
                return stop_if_moving(panel);
            }
            Key::Down => {
                self.selected = AxisIndex((selected.0 + 1) % panel.axes.len().max(1));
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
            // Space, Escape, focus loss or an unknown key.
            _ => return stop_all(),
        };
        vec![UiAction::For(axis_request)]
    }

    /// True if the key is held: it came before, and within the repeat time.
    fn hold(&mut self, key: Key, now: u64) -> bool {
        let before = self.held.filter(|held| held.key == key);
        let repeats = before.is_some_and(|held| {
            let within = if held.repeats {
                HOLD_TO_RUN_TIMEOUT / 1_000_000
            } else {
                REPEATS_WITHIN
            };
            now.saturating_sub(held.at) <= within
        });
        self.held = Some(HeldKey {
            key,
            at: now,
            repeats,
        });
        repeats
    }
}

/// Switching to another axis stops the current one, because its motion is no longer in view.
fn stop_if_moving(panel: &Panel) -> Vec<UiAction> {
    let jogs = |axis: &AxisPanel| matches!(axis.doing, Activity::Jogging { .. });
    let jogging = panel.axes.enumerate().filter(|(_, axis)| jogs(axis));
    jogging
        .map(|(axis, _)| UiAction::For(Request::Stop { axis }))
        .collect()
}

#[cfg(test)]
#[path = "ui_tests.rs"]
mod tests;
