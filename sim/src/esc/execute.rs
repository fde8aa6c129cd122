//! Processing of one datagram in one SubDevice: addressing, data and working counter (Beckhoff ESC
//! data sheet, section I, 2.4 and 2.5).

use super::Esc;
use super::access::ReadCombine;
use super::chip::feature;
use super::fmmu::{Overlap, Use};
use super::registers as reg;
use super::sm::BufferOwner;
use crate::bits;
use crate::frame::{Command, Datagram};

impl Esc {
    /// Processes a datagram in place. [`Esc::begin_frame`] must have announced its frame.
    pub fn execute(&mut self, frame: &mut [u8], datagram: &Datagram) {
        use Command as C;
        let adp = datagram.adp(frame);
        match datagram.command {
            C::Nop | C::Unknown(_) => {}
            C::Lrw if self.config.info.has(feature::NO_LRW) => {}
            C::Lrd | C::Lwr | C::Lrw => self.logical(frame, datagram),
            C::Aprd | C::Apwr | C::Aprw | C::Armw => {
                datagram.set_adp(frame, adp.wrapping_add(1));
                self.physical(frame, datagram, adp == 0);
            }
            C::Brd | C::Bwr | C::Brw => {
                datagram.set_adp(frame, adp.wrapping_add(1));
                self.physical(frame, datagram, true);
            }
            C::Fprd | C::Fpwr | C::Fprw | C::Frmw => {
                let addressed = adp == self.station || Some(adp) == self.alias;
                self.physical(frame, datagram, addressed);
            }
        }
        if self.frame.irq != 0 {
            datagram.or_irq(frame, self.frame.irq);
        }
    }

    fn physical(&mut self, frame: &mut [u8], datagram: &Datagram, addressed: bool) {
        use Command as C;
        let ado = datagram.ado(frame);
        let Some(data) = frame.get_mut(datagram.data.clone()) else {
            return;
        };
        let count = |done: bool, n: u16| if done { n } else { 0 };
        let wkc = match datagram.command {
            C::Aprd | C::Fprd if addressed => count(self.read(ado, data, ReadCombine::Replace), 1),
            C::Brd => count(self.read(ado, data, ReadCombine::Or), 1),
            C::Fpwr | C::Bwr if addressed => {
                let done = self.write(ado, data);
                // Only these two commands latch the time at every port.
                self.frame.latches_ports |= done && touches_receive_times(ado, data);
                count(done, 1)
            }
            C::Apwr if addressed => count(self.write(ado, data), 1),
            C::Aprw | C::Fprw | C::Brw if addressed => {
                let mut arrived = std::mem::take(&mut self.scratch);
                arrived.clear();
                arrived.extend_from_slice(data);
                let how = if datagram.command == C::Brw {
                    ReadCombine::Or
                } else {
                    ReadCombine::Replace
                };
                let read = self.read(ado, data, how);
                let offset = self.u16_at(reg::READ_WRITE_OFFSET);
                let written = self.write(ado.wrapping_add(offset), &arrived);
                self.scratch = arrived;
                count(read, 1) + count(written, 2)
            }
            C::Armw | C::Frmw if addressed => count(self.read(ado, data, ReadCombine::Replace), 1),
            C::Armw | C::Frmw => count(self.write(ado, data), 1),
            _ => 0,
        };
        if wkc > 0 {
            datagram.add_wkc(frame, wkc);
        }
    }

    fn logical(&mut self, frame: &mut [u8], datagram: &Datagram) {
        let address = datagram.logical(frame);
        let Some(data) = frame.get_mut(datagram.data.clone()) else {
            return;
        };
        let wkc = match datagram.command {
            Command::Lrd => u16::from(self.logical_read(address, data)),
            Command::Lwr => u16::from(self.logical_write(address, data)),
            // The read comes first; the write uses the received data.
            _ if self.fmmus.looped() => {
                let mut arrived = std::mem::take(&mut self.scratch);
                arrived.clear();
                arrived.extend_from_slice(data);
                let read = self.logical_read(address, data);
                let written = self.logical_write(address, &arrived);
                self.scratch = arrived;
                u16::from(read) + u16::from(written) * 2
            }
            // No byte is both read and written, so the order does not matter and no copy is needed.
            _ => {
                let written = self.logical_write(address, data);
                let read = self.logical_read(address, data);
                u16::from(read) + u16::from(written) * 2
            }
        };
        if wkc > 0 {
            datagram.add_wkc(frame, wkc);
        }
    }

    fn logical_write(&mut self, address: u32, data: &[u8]) -> bool {
        let mut any = false;
        let mut n = 0;
        let mut from = 0;
        let len = data.len();
        while let Ok(overlap) = self.fmmus.next_overlap(n, Use::Write, address, len, from) {
            match overlap {
                Some((overlap, next)) => {
                    any |= self.write_bits(&overlap, data);
                    from = next;
                }
                None => (n, from) = (n + 1, 0),
            }
        }
        any
    }

    fn logical_read(&mut self, address: u32, data: &mut [u8]) -> bool {
        let mut any = false;
        let mut n = 0;
        let mut from = 0;
        let len = data.len();
        while let Ok(overlap) = self.fmmus.next_overlap(n, Use::Read, address, len, from) {
            match overlap {
                Some((overlap, next)) => {
                    any |= self.read_bits(&overlap, data);
                    from = next;
                }
                None => (n, from) = (n + 1, 0),
            }
        }
        any
    }

    fn read_bits(&mut self, overlap: &Overlap, data: &mut [u8]) -> bool {
        let (mut at, end) = overlap.physical_bytes();
        let mut any = false;
        while at < end {
            let (len, place) = self.readable(at, end);
            if let Some(place) = place {
                let part = overlap.within(at, at + len);
                let from = place * 8 + part.physical_bit - at * 8;
                bits::copy(data, part.data_bit, &self.mem, from, part.bits);
                any = true;
            }
            at += len;
        }
        any
    }

    fn write_bits(&mut self, overlap: &Overlap, data: &[u8]) -> bool {
        let (mut at, end) = overlap.physical_bytes();
        if !self.may_write(at, end) {
            return false;
        }
        let mut any = false;
        while at < end {
            if at < reg::ADDRESS_SPACE {
                let stop = end.min(reg::ADDRESS_SPACE);
                any |= self.write_register_bits(at, stop, &overlap.within(at, stop), data);
                at = stop;
                continue;
            }
            let (len, place) = self.stretch(at, end, BufferOwner::ByMainDevice);
            if let Some(place) = place {
                let part = overlap.within(at, at + len);
                let to = place * 8 + part.physical_bit - at * 8;
                bits::copy(&mut self.mem, to, data, part.data_bit, part.bits);
                any = true;
            }
            at += len;
        }
        any
    }

    /// Writes the mapped bits of registers. Registers are written in whole bytes; other bits keep
    /// their readable value.
    fn write_register_bits(&mut self, at: usize, end: usize, part: &Overlap, data: &[u8]) -> bool {
        let mut bytes = std::mem::take(&mut self.register_bytes);
        bytes.clear();
        bytes.extend_from_slice(self.mem.get(at..end).unwrap_or_default());
        bits::copy(
            &mut bytes,
            part.physical_bit - at * 8,
            data,
            part.data_bit,
            part.bits,
        );
        let done = self.write_registers(at, &bytes);
        self.register_bytes = bytes;
        done
    }
}

fn touches_receive_times(ado: u16, data: &[u8]) -> bool {
    let start = usize::from(ado);
    super::access::overlaps(start, start + data.len(), reg::DC_RECEIVE_TIMES, 4)
}
