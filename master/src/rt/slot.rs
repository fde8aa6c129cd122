//! One axis in the cycle: its process data on one side, its feed on the other.

use ecaxis_axis::{Axis, AxisStatus, Command, Inputs, Outputs, Refused};

use super::feed::Feed;
use super::image::{AxisBits, SignalBits};
use crate::clock::Nanos;

/// One axis and where its objects are.
#[derive(Debug)]
pub struct AxisSlot {
    pub axis: Axis,
    pub bits: AxisBits,
    /// Index of its SubDevice.
    pub device: usize,
    /// The output that opens its brake, of whatever device.
    pub brake: Option<SignalBits>,
    /// The axes that it stops with.
    pub group: usize,
    pub feed: Feed,
    /// Largest following error while enabled, and the status of the last enabled cycle.
    pub largest_following_error: f64,
    pub last_enabled: Option<AxisStatus>,
    /// The last cycle with fresh inputs was due then.
    pub heard: Option<Nanos>,
    /// Enabling was ordered and the drive had no fault since: from now on a fault stops its group.
    pub(super) armed: bool,
    pub(super) ordered: bool,
    /// In this cycle.
    pub(super) acted: bool,
}

impl AxisSlot {
    #[must_use]
    pub fn new(axis: Axis, bits: AxisBits, device: usize, group: usize) -> Self {
        Self {
            axis,
            bits,
            device,
            brake: None,
            group,
            feed: Feed::default(),
            largest_following_error: 0.0,
            last_enabled: None,
            heard: None,
            armed: false,
            ordered: false,
            acted: false,
        }
    }

    /// It has been stopped and reset: what it reports concerns nobody until it is enabled again.
    pub(super) fn disarm(&mut self) {
        (self.armed, self.ordered) = (false, false);
    }

    pub(super) fn command(&mut self, command: Command) -> Result<(), Refused> {
        if self.feed.runs() && matches!(command, Command::SetMode(_) | Command::Home { .. }) {
            return Err(Refused::Following);
        }
        self.ordered |= command == Command::Enable;
        self.axis.command(command)?;
        // These leave the set-point alone.
        let aside = matches!(
            command,
            Command::Enable
                | Command::ResetFault
                | Command::SetMode(_)
                | Command::ArmProbe { .. }
                | Command::DisarmProbe { .. }
        );
        if !aside {
            self.feed.end();
        }
        Ok(())
    }

    pub(super) fn read(&self, image: &[u8], fresh: bool, late: bool) -> Inputs {
        let bits = &self.bits;
        Inputs {
            statusword: bits.statusword.get(image) as u16,
            position: bits.position.map(|b| b.get(image) as i32),
            velocity: bits.velocity.map(|b| b.get(image) as i32),
            torque: bits.torque.map(|b| b.get(image) as i16),
            mode_display: bits.mode_display.map(|b| b.get(image) as i8),
            error_code: bits.error_code.map(|b| b.get(image) as u16),
            touch_probe_status: bits.touch_probe_status.map(|b| b.get(image) as u16),
            touch_probe_positions: bits
                .touch_probe_positions
                .map(|b| b.map(|b| b.get(image) as i32)),
            fresh,
            late,
        }
    }

    pub(super) fn write(&self, image: &mut [u8], outputs: &Outputs) {
        let bits = &self.bits;
        bits.controlword.set(image, i64::from(outputs.controlword));
        for (to, value) in [
            (bits.mode, i64::from(outputs.mode)),
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
            let open = outputs.brake_open && keeps_power(outputs.controlword);
            brake.set(image, f64::from(u8::from(open)));
        }
    }
}

/// Whether a drive in Operation enabled keeps its motor under power by this Controlword (CiA 402-2, commands of the device
/// control): "Enable operation" and "Quick stop" do. A brake must not be open by any other.
const fn keeps_power(controlword: u16) -> bool {
    controlword & 0x0f == 0x0f || controlword & 0x06 == 0x02
}
