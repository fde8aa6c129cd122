//! The four ports of an ESC: media, links and loops, and the registers that show and control them:
//! DL control (0x0100), DL status (0x0110), error counters (0x0300–0x0313), receive times (0x0900).
//!
//! Source: Beckhoff ESC hardware data sheet, section I chapters 3, 4 and 14, section II chapters
//! 2.4 and 2.9.

use super::registers as reg;
use super::{Esc, event};
use crate::Nanos;

pub const PORTS: usize = 4;
/// A frame leaves its processing unit towards port 3 and passes the ports in this order.
pub const DOWNSTREAM: [u8; 3] = [3, 1, 2];
/// How long loop settings marked temporary (0x0100 bit 1) are used.
const TEMPORARY_NS: u64 = 1_000_000_000;
/// DL control: frames other than EtherCAT are destroyed, source addresses marked.
const DESTROY_FOREIGN: u8 = 0x01;
const TEMPORARY: u8 = 0x02;

/// What a port is made of, register 0x0007.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Medium {
    /// Not there, or not configured.
    #[default]
    None,
    Ebus,
    /// Ethernet through a PHY.
    Mii,
}

impl Medium {
    /// Register 0x0007: two bits a port, 0 none, 1 not configured, 2 EBUS, 3 MII.
    #[must_use]
    pub fn from_descriptor(descriptor: u8) -> [Self; PORTS] {
        [0, 2, 4, 6].map(|shift| match descriptor >> shift & 3 {
            2 => Self::Ebus,
            3 => Self::Mii,
            _ => Self::None,
        })
    }

    /// The ESI's `Physics`, one letter a port: `Y` MII, `H` MII with fast link-up, `K` EBUS,
    /// anything else nothing. A device without `Physics` has two MII ports.
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

    /// Register 0x0007.
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

/// Two bits a port of register 0x0101.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum LoopControl {
    /// As the link.
    Auto,
    /// Closes with the link, opens only when told to or when a frame arrives.
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
    /// End of temporary settings, and those before them.
    temporary: Option<(Nanos, u8)>,
    /// 0x0100 to 0x0103 was written; whether 0x0101 was.
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

    /// True where a lost link is to be counted.
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

    /// 0x0110 without what does not concern ports.
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

/// As the network sees the ports.
impl Esc {
    #[must_use]
    pub fn media(&self) -> [Medium; PORTS] {
        self.ports.media
    }

    pub(crate) fn links(&self) -> [bool; PORTS] {
        self.ports.link
    }

    /// Frames are sent and received at the port. With every loop closed, port 0 stays open so that
    /// the device can still be reached; DL status does not show it.
    pub(crate) fn port_open(&self, port: u8) -> bool {
        let open = &self.ports.open;
        open.get(usize::from(port)).copied().unwrap_or(false)
            || port == 0 && open.iter().all(|open| !open)
    }

    /// Frames that pass here are going round in circles if they do so twice: port 0 has lost its link.
    pub(crate) fn marks_circulating(&self) -> bool {
        !self.port_open(0)
            && matches!(
                LoopControl::of(self.ports.control, 0),
                LoopControl::Auto | LoopControl::AutoClose
            )
    }

    /// DL control bit 0: frames that are not EtherCAT end here, the others are marked.
    pub(crate) fn destroys_foreign(&self) -> bool {
        self.dl_control(0) & DESTROY_FOREIGN != 0
    }

    /// How much sooner a frame that comes in at the port is passed on with a smaller receive FIFO
    /// (DL control bits 16–18).
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

    /// The cable at the port has got or lost its link.
    pub(crate) fn set_link(&mut self, port: u8, up: bool) {
        if usize::from(port) >= PORTS {
            return;
        }
        if self.ports.set_link(usize::from(port), up) {
            self.count_up(reg::LOST_LINK + u16::from(port));
        }
        self.show_ports();
    }

    /// A frame that makes no sense passed the processing unit.
    pub(crate) fn count_processing_error(&mut self) {
        self.count_up(reg::PROCESSING_UNIT_ERRORS);
    }

    /// A frame with a bit error came in at the port, as the first to see it.
    pub(crate) fn count_rx_error(&mut self, port: u8) {
        self.count_up(reg::RX_ERRORS + 2 * u16::from(port));
        self.count_up(reg::RX_ERRORS + 2 * u16::from(port) + 1);
    }

    /// A frame came in at the port that another device has found to be wrong and marked.
    pub(crate) fn count_forwarded_error(&mut self, port: u8) {
        self.count_up(reg::FORWARDED_ERRORS + u16::from(port));
    }

    /// A valid frame has arrived at a closed port.
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

    /// DL control has been written, to take effect now that the frame is over.
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

    /// When temporary loop settings end.
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

    /// A frame that latches receive times came in at the port, perhaps on its way into the processing
    /// unit, which has noted the time itself.
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

/// As the registers see them.
impl Esc {
    pub(super) fn dl_control_written(&mut self, loops: bool) {
        self.ports.written = Some(loops || self.ports.written == Some(true));
    }

    /// Whether DL control, and so perhaps the way of frames, changed.
    pub(crate) fn dl_control_changed(&self) -> bool {
        self.ports.written.is_some()
    }

    /// Writes DL status; a change is an ECAT event.
    pub(super) fn show_ports(&mut self) {
        let before = self.u16_at(reg::DL_STATUS);
        let status = self.own_dl_status() | self.ports.status();
        if status != before {
            self.put(reg::DL_STATUS, &status.to_le_bytes());
            self.ecat_event(event::DL_STATUS);
        }
    }

    /// A write to any counter of a group clears the group, whatever is written.
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
