//! `[[line_shaft]]`: a master axis on another machine.

use ecaxis_axis::setpoint::{LineShaft, LineShaftConfig};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex, IndexVec, LineShaftIndex};
use toml::Spanned;

use super::duration::show;
use super::fields::{Key, KeyExt};
use super::problem::Problems;
use super::raw::RawLineShaft;
use super::steps::{ResolvedAxis, ResolvedDevice};
use super::units;

const MS: u64 = 1_000_000;
/// The default age of the newest set-point at which the stream has ended, in ns.
const TIMEOUT_NS: u64 = 50 * MS;
/// The default time within which a difference from the prediction decays, in ns.
const SMOOTHING_NS: u64 = 10 * MS;
/// The least number of cycles of a timeout.
const TIMEOUT_CYCLES: u64 = 4;

/// A line shaft of the machine file.
#[derive(Debug, Clone, PartialEq)]
pub struct LineShaftSetup {
    pub name: String,
    pub unit: String,
    pub config: LineShaftConfig,
    /// The shaft as it begins.
    pub shaft: LineShaft,
}

/// A name of the machine file, and its line shaft; `None` if that is invalid and has been reported.
#[derive(Debug)]
pub(crate) struct ResolvedLineShaft<'r> {
    pub name: &'r str,
    pub setup: Option<LineShaftSetup>,
}

/// Checks the line shafts. Devices and axes have other names.
pub(crate) fn check<'r>(
    raw: &'r [RawLineShaft],
    (devices, axes): (
        &IndexVec<DeviceIndex, ResolvedDevice<'_>>,
        &IndexVec<AxisIndex, ResolvedAxis<'_>>,
    ),
    cycle_ns: u64,
    p: &mut Problems<'_>,
) -> IndexVec<LineShaftIndex, ResolvedLineShaft<'r>> {
    let is_taken = |name: &str| {
        let mut devices = devices.iter().map(|device| device.name);
        let mut axes = axes.iter().map(|axis| axis.name);
        devices.any(|taken| taken == name) || axes.any(|taken| taken == name)
    };
    let mut shafts: Vec<ResolvedLineShaft<'r>> = Vec::new();
    for raw in raw {
        let Some(name) = &raw.name else { continue };
        let word = name.get_ref().as_str();
        if is_taken(word) || shafts.iter().any(|shaft| shaft.name == word) {
            let message = format!("the name `{word}` is taken");
            p.add_hint(name.span(), message, "give the line shaft another name");
            continue;
        }
        shafts.push(ResolvedLineShaft {
            name: word,
            setup: setup(raw, word, cycle_ns, p),
        });
    }
    shafts.into()
}

fn setup(
    raw: &RawLineShaft,
    name: &str,
    cycle_ns: u64,
    p: &mut Problems<'_>,
) -> Option<LineShaftSetup> {
    let unit = units::unit(raw.unit.as_ref(), p);
    let timeout_ns = raw.timeout.value().unwrap_or(TIMEOUT_NS);
    if timeout_ns < TIMEOUT_CYCLES * cycle_ns {
        let message = format!(
            "the timeout of {} ends within {TIMEOUT_CYCLES} cycles of {}",
            show(timeout_ns),
            show(cycle_ns)
        );
        let at = raw.timeout.place().unwrap_or_else(|| raw.span.clone());
        let hint = "write a `timeout` longer than the delay and the time between set-points";
        p.add_hint(at, message, hint);
        return None;
    }
    let timeout_s = timeout_ns as f64 * 1e-9;
    let mut positive = |value: &Key<f64>, key: &str| {
        let value = value.as_ref()?;
        above_zero(value, key, p)
    };
    let (velocity, acceleration) = (
        positive(&raw.velocity, "velocity"),
        positive(&raw.acceleration, "acceleration"),
    );
    let max_error = match &raw.max_error {
        Some(_) => positive(&raw.max_error, "max_error"),
        None => acceleration.map(|a| LineShaftConfig::largest_error(a, timeout_s)),
    };
    let (unit, velocity, acceleration, max_error) = (unit?, velocity?, acceleration?, max_error?);
    let config = LineShaftConfig {
        velocity,
        acceleration,
        timeout_s,
        smoothing_s: raw.smoothing.value().unwrap_or(SMOOTHING_NS) as f64 * 1e-9,
        max_error,
    };
    match LineShaft::new(config) {
        Ok(shaft) => Some(LineShaftSetup {
            name: name.to_owned(),
            unit,
            config,
            shaft,
        }),
        Err(error) => {
            p.add(raw.span.clone(), error.to_string());
            None
        }
    }
}

fn above_zero(value: &Spanned<f64>, key: &str, p: &mut Problems<'_>) -> Option<f64> {
    let number = *value.get_ref();
    if number > 0.0 {
        return Some(number);
    }
    p.add(value.span(), format!("`{key}` must be above 0"));
    None
}
