//! One axis in the cycle, between its process data and its set-point generator.

use ecaxis_axis::{
    Axis, AxisStatus, Command, CommandError, Delivery, DriveWords, Inputs, Outputs, StopMethod,
};
use ecaxis_ecat::index::{DeviceIndex, GroupIndex};

use super::gantry::Leader;
use super::gateway::NodePlace;
use super::image::{AxisBits, SignalBits};
use super::overrides::Rates;
use super::power_watch::PowerWatch;
use super::setpoint_generator::SetpointGenerator;
use crate::clock::Nanos;

/// One axis and the location of its objects.
#[derive(Debug)]
pub struct RtAxis {
    pub axis: Axis,
    pub bits: AxisBits,
    /// The words of the drive's profile.
    pub words: DriveWords,
    pub device: DeviceIndex,
    /// The node of an axis behind a gateway.
    pub node: Option<NodePlace>,
    /// The number of cycles from step to step: 1, or the gateway's SYNC period.
    pub cycles: u32,
    /// Whether fresh inputs have arrived since the last step, and what else shows that the drive has
    /// its targets.
    pub(super) arrived: (bool, Delivery),
    /// The counts of its second encoder, and their device.
    pub second_encoder: Option<(SignalBits, DeviceIndex)>,
    /// The output that opens its brake; it may be on any device.
    pub brake: Option<SignalBits>,
    pub group: GroupIndex,
    pub generator: SetpointGenerator,
    /// Largest following error while enabled, and the status of the last enabled cycle.
    pub largest_following_error: f64,
    pub last_enabled: Option<AxisStatus>,
    /// Due time of the last cycle with fresh inputs.
    pub heard: Option<Nanos>,
    /// The axis was enabled by command and its drive had no fault since: a fault now stops the
    /// group.
    pub(super) armed: bool,
    pub(super) ordered: bool,
    /// The drive needs a procedure command to clear its errors.
    pub(super) reset: bool,
    /// The axis was processed in this cycle.
    pub(super) acted: bool,
    /// The override of this cycle.
    pub(super) rates: Rates,
    /// The present hold has stopped the search for home.
    pub(super) stopped_by_hold: bool,
    pub(super) power: PowerWatch,
    /// The Controlword of the last outputs keeps the power.
    pub(super) keeps_power: bool,
    /// The first half of the gantry whose second half the axis is, while they are coupled.
    pub(super) leader: Option<Leader>,
}

impl RtAxis {
    #[must_use]
    pub fn new(axis: Axis, bits: AxisBits, device: DeviceIndex, group: GroupIndex) -> Self {
        Self {
            axis,
            bits,
            words: DriveWords::Cia402,
            device,
            node: None,
            cycles: 1,
            arrived: (false, Delivery::Unknown),
            second_encoder: None,
            brake: None,
            group,
            generator: SetpointGenerator::default(),
            largest_following_error: 0.0,
            last_enabled: None,
            heard: None,
            armed: false,
            ordered: false,
            reset: false,
            acted: false,
            rates: Rates::WHOLE,
            stopped_by_hold: false,
            power: PowerWatch::default(),
            keeps_power: false,
            leader: None,
        }
    }

    /// Returns the time from step to step in seconds.
    pub(super) fn dt_s(&self, cycle_ns: Nanos) -> f64 {
        cycle_ns as f64 * 1e-9 * f64::from(self.cycles)
    }

    /// Clears the armed state after a stop and reset: faults are ignored until the axis is enabled
    /// again.
    pub(super) fn disarm(&mut self) {
        (self.armed, self.ordered) = (false, false);
    }

    /// Stops the axis and ends its generator, whose next set-point would be refused.
    pub(super) fn stop_by(&mut self, method: StopMethod) {
        self.axis.stop_by(method);
        self.generator.end();
    }

    /// Returns the error with which [`Self::command`] would reject `Enable` or `Home` now.
    pub(super) fn check(&self, command: Command) -> Result<(), CommandError> {
        if self.generator.runs() && matches!(command, Command::SetMode(_) | Command::Home { .. }) {
            return Err(CommandError::Following);
        }
        self.axis.check(command)
    }

    pub(super) fn command(&mut self, command: Command) -> Result<(), CommandError> {
        self.check(command)?;
        self.ordered |= command == Command::Enable;
        self.axis.command(command)?;
        match command {
            Command::Enable => self.power.want(),
            Command::Disable
            | Command::QuickStop
            | Command::EmergencyStop
            | Command::DisableVoltage => self.power.end(),
            _ => {}
        }
        // These commands do not affect the set-point.
        let aside = matches!(
            command,
            Command::Enable
                | Command::ResetFault
                | Command::SetMode(_)
                | Command::ArmProbe { .. }
                | Command::DisarmProbe { .. }
        );
        if !aside {
            self.generator.end();
        }
        Ok(())
    }

    pub(super) fn read(&mut self, image: &[u8], fresh: bool, delivery: Delivery) -> Inputs {
        let bits = &self.bits;
        Inputs {
            statusword: self.words.statusword(bits.statusword.get(image) as u16),
            position: bits.position.map(|b| b.get(image) as i32),
            velocity: bits.velocity.map(|b| b.get(image) as i32),
            torque: bits.torque.map(|b| b.get(image) as i16),
            mode_display: bits.mode_display.map(|b| {
                let code = b.get(image) as i8;
                self.node.map_or(code, |_| epos::standard_mode(code))
            }),
            error_code: bits.error_code.map(|b| b.get(image) as u16),
            touch_probe_status: bits.touch_probe_status.map(|b| b.get(image) as u16),
            touch_probe_positions: bits
                .touch_probe_positions
                .map(|b| b.map(|b| b.get(image) as i32)),
            second_position: None,
            fresh,
            delivery,
        }
    }

    pub(super) fn write(&mut self, image: &mut [u8], outputs: &Outputs) {
        self.keeps_power = keeps_power(outputs.controlword);
        let control = self.words.control(outputs.controlword);
        self.reset |= control.reset;
        let bits = &self.bits;
        let mode = self
            .node
            .map_or(outputs.mode, |_| epos::vendor_mode(outputs.mode));
        bits.controlword.set(image, i64::from(control.word));
        for (to, value) in [
            (bits.mode, i64::from(mode)),
            (bits.target_position, i64::from(outputs.target_position)),
            (bits.target_velocity, i64::from(outputs.target_velocity)),
            (bits.target_torque, i64::from(outputs.target_torque)),
            (bits.velocity_offset, i64::from(outputs.velocity_offset)),
            (bits.torque_offset, i64::from(outputs.torque_offset)),
            (bits.profile_velocity, i64::from(outputs.profile_velocity)),
            (
                bits.profile_acceleration,
                i64::from(outputs.profile_acceleration),
            ),
            (
                bits.profile_deceleration,
                i64::from(outputs.profile_acceleration),
            ),
            (
                bits.touch_probe_function,
                i64::from(outputs.touch_probe_function),
            ),
        ] {
            if let Some(to) = to {
                to.set(image, value);
            }
        }
        if let Some(brake) = self.brake {
            let open = outputs.brake_open && self.keeps_power;
            brake.set(image, f64::from(u8::from(open)));
        }
    }
}

/// Modes of operation of the EPOS 24/1, 24/5 and 70/10. Their position, velocity and current mode
/// take a set-point without a profile, as CSP, CSV and CST do.
mod epos {
    pub(super) const fn vendor_mode(mode: i8) -> i8 {
        match mode {
            8..=10 => 7 - mode,
            other => other,
        }
    }

    pub(super) const fn standard_mode(mode: i8) -> i8 {
        match mode {
            -3..=-1 => 7 - mode,
            other => other,
        }
    }
}

/// Returns whether this Controlword keeps power on the motor of a drive in Operation enabled (CiA
/// 402-2, commands of the device control). "Enable operation" and "Quick stop" do. With any other
/// command the brake must be closed.
const fn keeps_power(controlword: u16) -> bool {
    controlword & 0x0f == 0x0f || controlword & 0x06 == 0x02
}
