//! The four ports of an ESC: media, links and loops, and the registers that show and control them:
//! DL control (0x0100), DL status (0x0110), error counters (0x0300–0x0313), receive times (0x0900).
//!
//! Source: Beckhoff ESC hardware data sheet, section I chapters 3, 4 and 14, section II chapters
//! 2.4 and 2.9.

use super::registers as reg;
use super::{Esc, event};
use crate::Nanos;

pub const PORTS: usize = 4;
/// The port order of a frame after the processing unit, which sends it towards port 3.
pub const DOWNSTREAM: [u8; 3] = [3, 1, 2];
/// The duration of temporary loop settings (0x0100 bit 1) in ns.
const TEMPORARY_NS: u64 = 1_000_000_000;
/// DL control bit: frames other than EtherCAT are destroyed, source addresses marked.
const DESTROY_FOREIGN: u8 = 0x01;
const TEMPORARY: u8 = 0x02;

/// The medium of a port, register 0x0007.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Medium {
    /// The port is missing or not configured.
    #[default]
    None,
    /// E-bus (LVDS).
    Ebus,
    /// Ethernet through a PHY.
    Mii,
}

impl Medium {
    /// Parses register 0x0007, two bits per port: 0 none, 1 not configured, 2 EBUS, 3 MII.
    #[must_use]
    pub fn from_descriptor(descriptor: u8) -> [Self; PORTS] {
        [0, 2, 4, 6].map(|shift| match descriptor >> shift & 3 {
            2 => Self::Ebus,
            3 => Self::Mii,
            _ => Self::None,
        })
    }

    /// Parses the ESI's `Physics`, one letter per port: `Y` MII, `H` MII with fast link-up, `K`
    /// EBUS, others no port. A device without `Physics` has two MII ports.
    #[must_use]
    pub fn from_physics(physics: &str) -> [Self; PORTS] {
        let mut media = [Self::None; PORTS];
        let physics = if physics.trim().is_empty() {
            "YY"
        } else {
            physics
        };
        for (medium, letter) in media.iter_mut().zip(physics.bytes()) {
            *medium = match letter.to_ascii_uppercase() {
                b'K' | b'E' => Self::Ebus,
                b'Y' | b'H' => Self::Mii,
                _ => Self::None,
            };
        }
        media
    }

    /// Returns register 0x0007.
    #[must_use]
    pub fn descriptor(media: [Self; PORTS]) -> u8 {
        media.iter().rev().fold(0, |bits, medium| {
            bits << 2
                | match medium {
                    Self::None => 0,
                    Self::Ebus => 2,
                    Self::Mii => 3,
                }
        })
    }
}

/// The loop setting of a port, two bits of register 0x0101.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum LoopControl {
    /// The loop follows the link.
    Auto,
    /// The loop closes with the link. It opens only on command or when a frame arrives.
    AutoClose,
    Open,
    Closed,
}

impl LoopControl {
    fn of(control: u8, port: usize) -> Self {
        match control >> (2 * port) & 3 {
            0 => Self::Auto,
            1 => Self::AutoClose,
            2 => Self::Open,
            _ => Self::Closed,
        }
    }
}

#[derive(Debug, Clone)]
pub(super) struct Ports {
    media: [Medium; PORTS],
    link: [bool; PORTS],
    open: [bool; PORTS],
    /// The loop settings in use, 0x0101.
    control: u8,
    /// The end of temporary settings, and the previous settings.
    temporary: Option<(Nanos, u8)>,
    /// `Some` if 0x0100 to 0x0103 was written; true if 0x0101 was.
    written: Option<bool>,
}

impl Ports {
    pub(super) fn new(descriptor: u8) -> Self {
        Self {
            media: Medium::from_descriptor(descriptor),
            link: [false; PORTS],
            open: [false; PORTS],
            control: 0,
            temporary: None,
            written: None,
        }
    }

    fn apply(&mut self, control: u8) {
        self.control = control;
        for port in 0..PORTS {
            self.open[port] = self.media[port] != Medium::None
                && match LoopControl::of(control, port) {
                    // Writing "auto close" again opens a port whose link is back.
                    LoopControl::Auto | LoopControl::AutoClose => self.link[port],
                    LoopControl::Open => true,
                    LoopControl::Closed => false,
                };
        }
    }

    /// Sets the link. Returns true if the loss of the link is counted.
    fn set_link(&mut self, port: usize, up: bool) -> bool {
        if self.media[port] == Medium::None || self.link[port] == up {
            return false;
        }
        self.link[port] = up;
        match LoopControl::of(self.control, port) {
            LoopControl::Auto => {
                self.open[port] = up;
                !up
            }
            LoopControl::AutoClose => {
                let was_open = self.open[port];
                self.open[port] &= up;
                !up && was_open
            }
            LoopControl::Open | LoopControl::Closed => false,
        }
    }

    /// Returns the port bits of 0x0110.
    fn status(&self) -> u16 {
        let bit = |set: bool, n: usize| u16::from(set) << n;
        (0..PORTS).fold(0, |status, port| {
            status
                | bit(self.link[port], 4 + port)
                | bit(!self.open[port], 8 + 2 * port)
                | bit(self.link[port], 9 + 2 * port)
        })
    }
}

/// The ports for the network.
impl Esc {
    #[must_use]
    pub fn media(&self) -> [Medium; PORTS] {
        self.ports.media
    }

    pub(crate) fn links(&self) -> [bool; PORTS] {
        self.ports.link
    }

    /// True if the port sends and receives frames. With every loop closed, port 0 stays open so
    /// that the device remains reachable; DL status does not show it.
    pub(crate) fn port_open(&self, port: u8) -> bool {
        let open = &self.ports.open;
        open.get(usize::from(port)).copied().unwrap_or(false)
            || port == 0 && open.iter().all(|open| !open)
    }

    /// True if port 0 has lost its link. A frame that passes twice then circulates.
    pub(crate) fn marks_circulating(&self) -> bool {
        !self.port_open(0)
            && matches!(
                LoopControl::of(self.ports.control, 0),
                LoopControl::Auto | LoopControl::AutoClose
            )
    }

    /// True if DL control bit 0 is set: frames other than EtherCAT end here, others are marked.
    pub(crate) fn destroys_foreign(&self) -> bool {
        self.dl_control(0) & DESTROY_FOREIGN != 0
    }

    /// Returns the delay in ns that a smaller receive FIFO saves for frames at this port (DL
    /// control bits 16–18).
    pub(crate) fn fifo_reduction_ns(&self, port: u8) -> u64 {
        let size = u64::from(self.dl_control(2) & 7);
        match self.ports.media.get(usize::from(port)) {
            Some(Medium::Ebus) => 50_u64.saturating_sub(10 * size),
            Some(Medium::Mii) if size < 4 => 40,
            _ => 0,
        }
    }

    fn dl_control(&self, byte: u16) -> u8 {
        self.bytes(reg::DL_CONTROL + byte, 1)
            .first()
            .copied()
            .unwrap_or(0)
    }

    /// Sets the link of the cable at the port.
    pub(crate) fn set_link(&mut self, port: u8, up: bool) {
        if usize::from(port) >= PORTS {
            return;
        }
        if self.ports.set_link(usize::from(port), up) {
            self.count_up(reg::LOST_LINK + u16::from(port));
        }
        self.show_ports();
    }

    /// Counts an invalid frame in the processing unit.
    pub(crate) fn count_processing_error(&mut self) {
        self.count_up(reg::PROCESSING_UNIT_ERRORS);
    }

    /// Counts a frame with a bit error that this port detects first.
    pub(crate) fn count_rx_error(&mut self, port: u8) {
        self.count_up(reg::RX_ERRORS + 2 * u16::from(port));
        self.count_up(reg::RX_ERRORS + 2 * u16::from(port) + 1);
    }

    /// Counts an invalid frame that another device has already marked.
    pub(crate) fn count_forwarded_error(&mut self, port: u8) {
        self.count_up(reg::FORWARDED_ERRORS + u16::from(port));
    }

    /// Handles a valid frame at a closed port.
    pub(crate) fn frame_at_closed_port(&mut self, port: u8) {
        let n = usize::from(port);
        let waits = LoopControl::of(self.ports.control, n & 3) == LoopControl::AutoClose;
        if let (true, Some(true), Some(open)) = (
            waits,
            self.ports.link.get(n).copied(),
            self.ports.open.get_mut(n),
        ) {
            *open = true;
            self.show_ports();
        }
    }

    /// Applies a write to DL control after the end of the frame.
    pub(crate) fn settle_ports(&mut self, now: Nanos) {
        let Some(loops) = self.ports.written.take() else {
            return;
        };
        let control = self.dl_control(1);
        if !loops {
            return;
        }
        self.ports.temporary = (self.dl_control(0) & TEMPORARY != 0).then(|| {
            let before = self.ports.temporary.map(|(_, before)| before);
            (
                now.saturating_add(TEMPORARY_NS),
                before.unwrap_or(self.ports.control),
            )
        });
        self.ports.apply(control);
        self.show_ports();
    }

    /// Returns the end of temporary loop settings.
    pub(crate) fn ports_due(&self) -> Option<Nanos> {
        self.ports.temporary.map(|(until, _)| until)
    }

    /// Ends temporary loop settings whose time is over.
    pub(crate) fn revert_ports(&mut self, now: Nanos) {
        if let Some((until, before)) = self.ports.temporary
            && until <= now
        {
            self.ports.temporary = None;
            let rule = self.dl_control(0) & !TEMPORARY;
            self.put(reg::DL_CONTROL, &[rule, before]);
            self.ports.apply(before);
            self.show_ports();
        }
    }

    /// Latches the receive time of a frame at the port. `processed`: the frame enters the
    /// processing unit, which has latched the time itself.
    pub(crate) fn latch_port(&mut self, port: u8, now: Nanos, processed: bool) {
        if usize::from(port) >= PORTS {
            return;
        }
        let stamp = if processed && port == 0 {
            self.frame.stamp
        } else {
            self.stamp(now)
        };
        let at = reg::DC_RECEIVE_TIMES + 4 * u16::from(port);
        self.put(at, &(stamp as u32).to_le_bytes());
    }
}

/// The ports for the registers.
impl Esc {
    pub(super) fn dl_control_written(&mut self, loops: bool) {
        self.ports.written = Some(loops || self.ports.written == Some(true));
    }

    /// True if DL control changed, which may change the path of frames.
    pub(crate) fn dl_control_changed(&self) -> bool {
        self.ports.written.is_some()
    }

    /// Updates DL status; a change raises an ECAT event.
    pub(super) fn show_ports(&mut self) {
        let before = self.u16_at(reg::DL_STATUS);
        let status = self.own_dl_status() | self.ports.status();
        if status != before {
            self.put(reg::DL_STATUS, &status.to_le_bytes());
            self.ecat_event(event::DL_STATUS);
        }
    }

    /// Clears the counter groups with a written counter, regardless of the value.
    pub(super) fn clear_counters(&mut self, touched: impl Fn(u16, usize) -> bool) {
        for (first, len) in [
            (reg::RX_ERRORS, 12),
            (reg::PROCESSING_UNIT_ERRORS, 1),
            (reg::LOST_LINK, 4),
        ] {
            if touched(first, len) {
                self.bytes_mut(first, len as u16).fill(0);
            }
        }
        if touched(reg::PDI_ERRORS, 1) {
            self.bytes_mut(reg::PDI_ERRORS, 3).fill(0);
        }
    }
}
