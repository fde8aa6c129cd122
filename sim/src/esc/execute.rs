//! One datagram at one SubDevice: addressing, data and working counter.

use super::Esc;
use super::access::Combine;
use super::registers as reg;
use crate::Nanos;
use crate::bits;
use crate::frame::{Command, Datagram};

/// Longest physical read-modify-write; a datagram cannot be longer.
const MAX_DATA: usize = 1500;

impl Esc {
    /// Processes a datagram in place. `now` is when the frame's first byte arrived.
    pub fn execute(&mut self, frame: &mut [u8], datagram: &Datagram, now: Nanos, local: u64) {
        use Command as C;
        let adp = datagram.adp(frame);
        match datagram.command {
            C::Nop | C::Unknown(_) => {}
            C::Lrd | C::Lwr | C::Lrw => self.logical(frame, datagram, now, local),
            C::Aprd | C::Apwr | C::Aprw | C::Armw => {
                datagram.set_adp(frame, adp.wrapping_add(1));
                self.physical(frame, datagram, adp == 0, now, local);
            }
            C::Brd | C::Bwr | C::Brw => {
                datagram.set_adp(frame, adp.wrapping_add(1));
                self.physical(frame, datagram, true, now, local);
            }
            C::Fprd | C::Fpwr | C::Fprw | C::Frmw => {
                let addressed = adp == self.station || Some(adp) == self.alias;
                self.physical(frame, datagram, addressed, now, local);
            }
        }
        let irq = self.u16_at(reg::ECAT_EVENT) & self.u16_at(reg::ECAT_EVENT_MASK);
        if irq != 0 {
            datagram.or_irq(frame, irq);
        }
    }

    fn physical(
        &mut self,
        frame: &mut [u8],
        datagram: &Datagram,
        addressed: bool,
        now: Nanos,
        local: u64,
    ) {
        use Command as C;
        let ado = datagram.ado(frame);
        let Some(data) = frame.get_mut(datagram.data.clone()) else {
            return;
        };
        let count = |done: bool, n: u16| if done { n } else { 0 };
        let wkc = match datagram.command {
            C::Aprd | C::Fprd if addressed => {
                count(self.read(ado, data, Combine::Replace, local), 1)
            }
            C::Brd => count(self.read(ado, data, Combine::Or, local), 1),
            C::Apwr | C::Fpwr | C::Bwr if addressed => count(self.write(ado, data, now, local), 1),
            C::Aprw | C::Fprw | C::Brw if addressed => {
                let mut written = [0; MAX_DATA];
                let Some(written) = written.get_mut(..data.len()) else {
                    return;
                };
                written.copy_from_slice(data);
                let how = if datagram.command == C::Brw {
                    Combine::Or
                } else {
                    Combine::Replace
                };
                let read = self.read(ado, data, how, local);
                count(read, 1) + count(self.write(ado, written, now, local), 2)
            }
            C::Armw | C::Frmw if addressed => {
                count(self.read(ado, data, Combine::Replace, local), 1)
            }
            C::Armw | C::Frmw => count(self.write(ado, data, now, local), 1),
            _ => 0,
        };
        if wkc > 0 {
            datagram.add_wkc(frame, wkc);
        }
    }

    fn logical(&mut self, frame: &mut [u8], datagram: &Datagram, now: Nanos, local: u64) {
        let address = datagram.logical(frame);
        let Some(data) = frame.get_mut(datagram.data.clone()) else {
            return;
        };
        let mut wkc = 0;
        // What arrived goes out to the device before inputs take its place, also where several
        // FMMUs share logical addresses.
        if datagram.command != Command::Lrd && self.logical_write(address, data, now, local) {
            wkc += if datagram.command == Command::Lrw {
                2
            } else {
                1
            };
        }
        if datagram.command != Command::Lwr && self.logical_read(address, data, local) {
            wkc += 1;
        }
        if wkc > 0 {
            datagram.add_wkc(frame, wkc);
        }
    }

    fn logical_write(&mut self, address: u32, data: &[u8], now: Nanos, local: u64) -> bool {
        let mut any = false;
        for n in 0..self.fmmus.len() {
            let Some(fmmu) = self.fmmus[n].filter(|fmmu| fmmu.write) else {
                continue;
            };
            let Some(o) = fmmu.overlap(address, data.len()) else {
                continue;
            };
            let start = o.physical_bit / 8;
            let len = (o.physical_bit + o.bits).div_ceil(8) - start;
            if start < reg::ADDRESS_SPACE {
                let bytes = data.get(o.data_bit / 8..(o.data_bit + o.bits) / 8);
                let aligned = (o.data_bit | o.physical_bit | o.bits).is_multiple_of(8);
                if let (true, Some(bytes), Ok(start)) = (aligned, bytes, u16::try_from(start)) {
                    any |= self.write(start, bytes, now, local);
                }
            } else if self.begin_write(start, len) {
                bits::copy(&mut self.mem, o.physical_bit, data, o.data_bit, o.bits);
                self.end_write(start, len, local);
                any = true;
            }
        }
        any
    }

    fn logical_read(&mut self, address: u32, data: &mut [u8], local: u64) -> bool {
        let mut any = false;
        for n in 0..self.fmmus.len() {
            let Some(fmmu) = self.fmmus[n].filter(|fmmu| fmmu.read) else {
                continue;
            };
            let Some(o) = fmmu.overlap(address, data.len()) else {
                continue;
            };
            let start = o.physical_bit / 8;
            let len = (o.physical_bit + o.bits).div_ceil(8) - start;
            if self.begin_read(start, len, local) {
                bits::copy(data, o.data_bit, &self.mem, o.physical_bit, o.bits);
                self.end_read(start, len);
                any = true;
            }
        }
        any
    }
}
