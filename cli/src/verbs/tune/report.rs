//! Estimates, gains and plots of a tuned axis.

use std::fmt::Write as _;
use std::path::Path;

use ecaxis_axis::Mode;
use ecaxis_master::config::AxisSetup;
use ecaxis_tools::tune::TuneError;
use ecaxis_tools::tune::bode::{self, Plot};
use ecaxis_tools::tune::excitation::Excitation;
use ecaxis_tools::tune::excite::Record;
use ecaxis_tools::tune::fit::{Plant, TorqueSource, fit};
use ecaxis_tools::tune::gains::{
    DriveLoop, Motor, Targets, TorqueLoop, VelocityLoop, drive_position, drive_velocity,
    torque_loop, velocity_loop,
};
use ecaxis_tools::tune::margins::{Margins, unwrapped};
use ecaxis_tools::tune::objects::GainObject;
use ecaxis_tools::tune::response::{Response, Spectra};
use serde_json::{Value, json};

/// The longest dead time that is looked for, in s.
const LONGEST_S: f64 = 0.05;
/// The drive's filter of the measured velocity, in Hz, for the proposed velocity loop.
const FILTER_HZ: f64 = 318.0;
/// The phase margin of the drive's position loop, whose filtered derivative part allows no more.
const DRIVE_POSITION_PHASE: f64 = 45.0;

/// A gain of the drive, as the value of its object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DriveGain {
    pub object: &'static GainObject,
    pub si: f64,
    pub raw: u32,
}

/// What is known of an axis after an excitation.
#[derive(Debug)]
pub(super) struct Evaluated {
    axis: String,
    unit: String,
    mode: Mode,
    periods: usize,
    coherence: f64,
    plant: Plant,
    /// Torque to position in the commanded torque, for loops over torques.
    delay_s: Option<f64>,
    /// The delay of following, at low frequencies.
    following_s: f64,
    mean_torque: f64,
    motor: Option<Motor>,
    torque_loop: Option<TorqueLoop>,
    velocity_loop: Option<VelocityLoop>,
    position: Option<DriveLoop>,
    velocity: Option<DriveLoop>,
    plots: Vec<Plot>,
}

/// Returns the samples as CSV, in units of the axis and percent of rated torque.
pub(super) fn samples(plan: &Excitation, record: &Record, setup: &AxisSetup) -> String {
    let mut out = format!(
        "time_s,excitation,target_velocity,target_torque,position,torque,fresh\n# axis {}, unit {}, period {} samples\n",
        setup.name,
        setup.unit,
        plan.samples.len()
    );
    for (n, sample) in record.samples.iter().enumerate() {
        let _ = writeln!(
            out,
            "{:.6},{},{},{},{},{},{}",
            n as f64 * plan.dt_s,
            sample.excitation,
            sample.target_velocity,
            sample.target_torque,
            sample.position,
            sample.torque,
            u8::from(sample.fresh)
        );
    }
    out
}

/// Returns the delay that the phase shows at low frequencies.
fn delay(response: &Response) -> f64 {
    let low = response.len().div_ceil(4);
    let phases = unwrapped(response);
    let pairs = response.iter().zip(phases).take(low);
    let delays = pairs.map(|((w, _), phase)| -phase / w);
    delays.sum::<f64>() / low.max(1) as f64
}

/// Evaluates the spectra of an axis.
pub(super) fn evaluate(
    plan: &Excitation,
    spectra: &Spectra,
    setup: &AxisSetup,
    targets: &Targets,
) -> Result<Evaluated, TuneError> {
    let config = &setup.config;
    let torque_mode = config.mode == Mode::Cst;
    let reported = spectra.lines.iter().any(|line| line.torque.norm() > 0.0);
    if !reported && !torque_mode {
        return Err(TuneError::Fit(
            "the drive reports no torque: map 0x6077 (`pdo.tx`), or tune in mode cst".to_owned(),
        ));
    }
    let commanded = torque_mode
        .then(|| fit(&spectra.lines, TorqueSource::Commanded, LONGEST_S))
        .transpose()?;
    let plant = match reported {
        true => fit(&spectra.lines, TorqueSource::Reported, LONGEST_S)?,
        false => commanded.ok_or_else(|| TuneError::Fit("no torque".to_owned()))?,
    };
    let resonance = plant
        .resonance
        .map_or(f64::INFINITY, |r| r.antiresonance_hz / 3.0);
    let targets = Targets {
        bandwidth_hz: targets.bandwidth_hz.min(resonance),
        ..*targets
    };
    let motor = setup
        .torque
        .rated
        .zip(setup.torque.constant)
        .map(|(rated, constant)| {
            // One rad/s² of the motor in units.
            let unit = config.scale.units_per_turn() / std::f64::consts::TAU;
            Motor {
                inertia: plant.inertia / 100.0 * rated * unit,
                viscous: (plant.viscous / 100.0 * rated * unit).max(0.0),
                torque_constant: constant,
            }
        });
    let over = |mode: Mode, response: Response| (config.mode == mode).then_some(response);
    let over_torque = over(Mode::Cst, spectra.over_torque());
    let over_velocity = over(Mode::Csv, spectra.over_velocity());
    let drive_targets = Targets {
        phase_deg: DRIVE_POSITION_PHASE.min(targets.phase_deg),
        ..targets
    };
    let coherence: Vec<f64> = spectra.lines.iter().map(|line| line.coherence).collect();
    let plot = |name: &str, unit: String, response: Response| Plot {
        name: name.to_owned(),
        unit,
        response,
        coherence: coherence.clone(),
    };
    let mut plots = Vec::new();
    if reported {
        let unit = format!("{} per % of rated torque", setup.unit);
        plots.push(plot("Position over reported torque", unit, spectra.plant()));
    }
    if let Some(response) = &over_torque {
        let unit = format!("{} per % of rated torque", setup.unit);
        plots.push(plot(
            "Position over commanded torque",
            unit,
            response.clone(),
        ));
    }
    if let Some(response) = &over_velocity {
        plots.push(plot(
            "Position over commanded velocity",
            "s".to_owned(),
            response.clone(),
        ));
    }
    let following = spectra.following();
    if !torque_mode {
        plots.push(plot(
            "Position over set-point",
            String::new(),
            following.clone(),
        ));
    }
    let worst = coherence.iter().copied().fold(1.0, f64::min);
    Ok(Evaluated {
        axis: setup.name.clone(),
        unit: setup.unit.clone(),
        mode: config.mode,
        periods: spectra.periods,
        coherence: worst,
        plant,
        delay_s: commanded.map(|plant| plant.delay_s),
        following_s: delay(&following),
        mean_torque: spectra.mean_torque,
        motor,
        torque_loop: over_torque.and_then(|response| torque_loop(&response, plan.dt_s, &targets)),
        velocity_loop: over_velocity.and_then(|response| velocity_loop(&response, &targets)),
        position: motor.and_then(|motor| drive_position(&motor, &drive_targets)),
        velocity: motor.and_then(|motor| drive_velocity(&motor, FILTER_HZ, &targets)),
        plots,
    })
}

fn margins(found: &Margins) -> String {
    let fall = found
        .fall_db
        .map_or(String::new(), |fall| format!(" and −{fall:.1} dB"));
    format!(
        "crossover {:.1} Hz, phase margin {:.0}°, gain margin {:.1} dB{fall}",
        found.crossover_hz, found.phase_deg, found.rise_db
    )
}

impl Evaluated {
    /// Returns the gains of the drive: position and velocity loop, feed-forward, observer.
    pub(super) fn drive_gains(&self) -> Vec<DriveGain> {
        let Some(motor) = self.motor else {
            return Vec::new();
        };
        let kt = motor.torque_constant;
        let position = self.position.iter().flat_map(|own| {
            [
                (0x30a1, 1, own.p),
                (0x30a1, 2, own.i),
                (0x30a1, 3, own.d),
                (0x30a1, 4, motor.viscous / kt),
                (0x30a1, 5, motor.inertia / kt),
            ]
        });
        let velocity = self.velocity.iter().flat_map(|own| {
            [
                (0x30a2, 1, own.p),
                (0x30a2, 2, own.i),
                (0x30a2, 3, motor.viscous / kt),
                (0x30a2, 4, motor.inertia / kt),
            ]
        });
        let observer = [(0x30a3, 4, motor.viscous), (0x30a3, 5, motor.inertia)];
        let all = position.chain(velocity).chain(observer);
        all.filter_map(|(index, sub, si)| {
            let object = GainObject::find(index, sub)?;
            Some(DriveGain {
                object,
                si,
                raw: object.to_raw(si),
            })
        })
        .collect()
    }

    /// Returns the lines of the machine file that follow from the estimates.
    fn keys(&self) -> Vec<String> {
        let mut keys = Vec::new();
        let ms = |s: f64| format!("{:.1}ms", s * 1e3);
        match self.mode {
            Mode::Cst => {
                if let Some(own) = &self.torque_loop {
                    keys.push(format!(
                        "cst = {{ kp = {:.5}, tn = \"{}\", tv = \"{}\", acceleration = {:.6} }}   # {}",
                        own.kp,
                        ms(own.tn_s),
                        ms(own.tv_s),
                        self.plant.inertia,
                        margins(&own.margins)
                    ));
                }
                keys.extend(
                    self.delay_s
                        .map(|delay| format!("dead_time = \"{}\"", ms(delay))),
                );
            }
            Mode::Csv => {
                if let Some(own) = &self.velocity_loop {
                    keys.push(format!(
                        "csv = {{ kv = {:.2}, feed_forward = 1.0 }}   # {}",
                        own.kv,
                        margins(&own.margins)
                    ));
                }
                keys.push(format!("dead_time = \"{}\"", ms(self.following_s)));
            }
            _ => {
                keys.push(format!(
                    "csp = {{ torque_offset = {:.6} }}   # needs 0x60B2 in the process data",
                    self.plant.inertia
                ));
                keys.push(format!("dead_time = \"{}\"", ms(self.following_s)));
            }
        }
        keys
    }

    /// Returns the estimates and gains as text.
    fn values(&self, file: &Path) -> String {
        let mut out = String::new();
        let (plant, unit) = (&self.plant, &self.unit);
        let mut line = |name: &str, value: String| {
            let _ = writeln!(out, "{name:<22}{value}");
        };
        line(
            "periods",
            format!("{}, least coherence {:.3}", self.periods, self.coherence),
        );
        line(
            "inertia",
            format!(
                "{:.6} % per {unit}/s²{}",
                plant.inertia,
                self.motor.map_or(String::new(), |motor| format!(
                    ", {:.3e} kg·m² at the motor",
                    motor.inertia
                ))
            ),
        );
        line(
            "viscous friction",
            format!("{:.6} % per {unit}/s", plant.viscous),
        );
        line("Coulomb friction", format!("{:.2} %", plant.coulomb));
        line(
            "constant torque",
            format!("{:.2} % (0x60B2 can carry it)", self.mean_torque),
        );
        if let Some(delay) = self.delay_s {
            line("dead time of torque", format!("{:.2} ms", delay * 1e3));
        } else {
            line(
                "delay of following",
                format!("{:.2} ms", self.following_s * 1e3),
            );
        }
        line(
            "not explained",
            format!("{:.1} % of the torque", plant.residual * 100.0),
        );
        if let Some(found) = plant.resonance {
            line(
                "resonance",
                format!(
                    "{:.1} Hz, antiresonance {:.1} Hz",
                    found.resonance_hz, found.antiresonance_hz
                ),
            );
        }
        let _ = writeln!(out, "\nFor `[device.axis]` of `{}`:", self.axis);
        for key in self.keys() {
            let _ = writeln!(out, "  {key}");
        }
        if self.motor.is_none() {
            let _ = writeln!(
                out,
                "\nNo gains of the drive: `rated_torque` and `torque_constant` are not in the file."
            );
            return out;
        }
        let gains = self.drive_gains();
        let _ = writeln!(out, "\nFor an EPOS4 or IDX (`--apply` writes them):");
        for (name, own) in [
            ("position loop", &self.position),
            ("velocity loop", &self.velocity),
        ] {
            let text = own
                .as_ref()
                .map_or("no gains meet the margins".to_owned(), |own| {
                    margins(&own.margins)
                });
            let _ = writeln!(out, "  {name}: {text}");
        }
        for gain in gains {
            let object = gain.object;
            let _ = writeln!(
                out,
                "  ecaxis sdo write {} DEVICE 0x{:04X}:{:02X} {:<10} # {}, {:.4} {}",
                file.display(),
                object.index,
                object.sub,
                gain.raw,
                object.name,
                gain.si / object.si,
                object.unit
            );
        }
        out
    }

    pub(super) fn text(&self, file: &Path) -> String {
        let plots: Vec<String> = self.plots.iter().map(bode::text).collect();
        format!("{}\n{}", plots.join("\n"), self.values(file))
    }

    pub(super) fn page(&self, file: &Path) -> String {
        bode::page(
            &format!("Axis {}", self.axis),
            &self.values(file),
            &self.plots,
        )
    }

    pub(super) fn json(&self) -> Value {
        let plots = self.plots.iter().map(|plot| {
            let lines = plot.response.iter().zip(&plot.coherence).map(|((w, value), coherence)| {
                json!({
                    "hz": w / std::f64::consts::TAU, "real": value.re, "imaginary": value.im, "coherence": coherence,
                })
            });
            json!({ "name": plot.name, "unit": plot.unit, "lines": lines.collect::<Vec<_>>() })
        });
        let drive = self.drive_gains().into_iter().map(|gain| {
            json!({
                "index": gain.object.index, "sub": gain.object.sub, "name": gain.object.name,
                "value": gain.raw, "si": gain.si,
            })
        });
        json!({
            "axis": self.axis, "unit": self.unit, "mode": self.mode.to_string(), "periods": self.periods,
            "least_coherence": self.coherence,
            "estimates": {
                "inertia": self.plant.inertia, "viscous_friction": self.plant.viscous,
                "coulomb_friction": self.plant.coulomb, "constant_torque": self.mean_torque,
                "torque_dead_time_s": self.delay_s, "following_delay_s": self.following_s,
                "not_explained": self.plant.residual,
                "antiresonance_hz": self.plant.resonance.map(|found| found.antiresonance_hz),
                "resonance_hz": self.plant.resonance.map(|found| found.resonance_hz),
                "motor": self.motor,
            },
            "loops": {
                "cst": self.torque_loop, "csv": self.velocity_loop,
                "drive_position": self.position, "drive_velocity": self.velocity,
            },
            "keys": self.keys(), "drive": drive.collect::<Vec<_>>(), "responses": plots.collect::<Vec<_>>(),
        })
    }
}
