//! `ecaxis sim --trace`: the true state of the simulated drives as CSV.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, Write as _};

use ecaxis_sim::{Nanos, Segment, SimDevice};

const HEAD: &str = "time_ns,position,device,al_state,al_status_code,outputs_age_ns,controlword,statusword,velocity,sync0_ns\n";
const PERIOD: Nanos = 1_000_000;

/// Writes one line per device and millisecond. Each sample is flushed, so that it can be read while
/// the bus is served.
pub(crate) struct Trace {
    file: File,
    next: Nanos,
    lines: String,
}

impl Trace {
    pub fn new(mut file: File) -> io::Result<Self> {
        file.write_all(HEAD.as_bytes())?;
        Ok(Self {
            file,
            next: 0,
            lines: String::new(),
        })
    }

    /// Writes a sample if one is due.
    pub fn sample(&mut self, segment: &Segment, now: Nanos) -> io::Result<()> {
        if now < self.next {
            return Ok(());
        }
        self.next = now + PERIOD;
        self.lines.clear();
        for position in 0..segment.len() {
            if let Some(device) = segment.device(position) {
                let age = |at: Nanos| segment.world_time(now).saturating_sub(at);
                let (outputs, sync0) = (device.outputs_log().last(), device.sync0_log().last());
                let sync0 = sync0.map(|at| now.saturating_sub(age(at)));
                let times = [outputs.map(age), sync0];
                line(&mut self.lines, now, position, device, times);
            }
        }
        self.file.write_all(self.lines.as_bytes())
    }
}

/// Formats one line with the age of the outputs and the time of the last pulse of SYNC0. Without
/// power there is no AL state. Devices that are not drives have no Controlword, Statusword or
/// velocity.
fn line(
    lines: &mut String,
    now: Nanos,
    position: usize,
    device: &SimDevice,
    times: [Option<Nanos>; 2],
) {
    let state = match device.has_power() {
        true => device.al_state().to_string(),
        false => String::new(),
    };
    let (name, code) = (device.name(), device.al_status_code());
    let [age, sync0] = times.map(|time| time.map(|time| time.to_string()).unwrap_or_default());
    // Writing to a String cannot fail.
    let _ = write!(lines, "{now},{position},{name},{state},0x{code:04x},{age},");
    let _ = match device.drive() {
        Some(drive) => {
            let word = |index| match device.object(index, 0).as_deref() {
                Some(&[low, high]) => u16::from_le_bytes([low, high]),
                _ => 0,
            };
            let (control, status) = (word(0x6040), word(0x6041));
            let velocity = drive.velocity_rev_s();
            writeln!(
                lines,
                "0x{control:04x},0x{status:04x},{velocity:.4},{sync0}"
            )
        }
        None => writeln!(lines, ",,,{sync0}"),
    };
}
