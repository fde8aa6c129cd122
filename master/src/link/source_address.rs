//! Distinguishes programs on the same interface by their source address. A running machine must not
//! take the answers to another program's scan for its own.

use super::redundant::RingStatus;
use super::{Link, LinkError, LinkStats, MAX_FRAME, Nanos};

/// The last two bytes of the source address; the first four are the same in all frames of this
/// program.
const TAIL: std::ops::Range<usize> = 10..12;
/// The tag of programs without a cycle; ethercrab's is 0x10, the cycle's is 0x20.
const ACYCLIC_BIT: u8 = 0x30;

/// Returns the source address of a program without a cycle. `number` distinguishes programs.
pub(super) fn acyclic_address(number: u32) -> [u8; 6] {
    let [s0, s1, s2, s3] = super::filter::SOURCE;
    let [tail, kind] = acyclic_tail(number);
    [s0, s1, s2, s3, tail, kind]
}

const fn acyclic_tail(number: u32) -> [u8; 2] {
    [number.to_le_bytes()[0], ACYCLIC_BIT]
}

/// True if a frame was sent by a program without a cycle.
pub(super) fn is_acyclic_client_frame(frame: &[u8]) -> bool {
    frame.get(TAIL).is_some_and(|tail| tail[1] == ACYCLIC_BIT)
}

/// Sends all frames from a separate address, and returns only the frames that come back to it.
#[derive(Debug)]
pub struct PrivateMacLink {
    link: Box<dyn Link>,
    tail: [u8; 2],
    /// The address bytes of the frames before they were replaced.
    given: [u8; 2],
    frame: Box<[u8; MAX_FRAME]>,
    others: u64,
}

impl PrivateMacLink {
    /// `number` distinguishes programs, for example a process id.
    #[must_use]
    pub fn new(link: Box<dyn Link>, number: u32) -> Self {
        Self {
            link,
            tail: acyclic_tail(number),
            given: [0; 2],
            frame: Box::new([0; MAX_FRAME]),
            others: 0,
        }
    }
}

impl Link for PrivateMacLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        let Some(copy) = self.frame.get_mut(..frame.len()) else {
            return Err(LinkError::TooLong(frame.len()));
        };
        copy.copy_from_slice(frame);
        if let Some(tail) = copy.get_mut(TAIL) {
            for ((byte, given), own) in tail.iter_mut().zip(&mut self.given).zip(self.tail) {
                *given = *byte;
                *byte = own;
            }
        }
        self.link.send(copy)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        while let Some(len) = self.link.recv(buf)? {
            match buf.get_mut(TAIL) {
                Some(tail) if *tail == self.tail => {
                    tail.copy_from_slice(&self.given);
                    return Ok(Some(len));
                }
                _ => self.others += 1,
            }
        }
        Ok(None)
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.link.next_arrival()
    }

    fn main_devices(&self) -> u64 {
        self.link.main_devices()
    }

    fn stats(&mut self) -> LinkStats {
        let mut stats = self.link.stats();
        stats.foreign += self.others;
        stats
    }

    fn ring(&self) -> Option<&'static RingStatus> {
        self.link.ring()
    }

    fn nic(&self) -> Option<&str> {
        self.link.nic()
    }

    fn finish(self: Box<Self>) -> std::io::Result<Option<super::capture::RecordStats>> {
        self.link.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the sent frames and frames of other programs.
    #[derive(Debug, Default)]
    struct Echo {
        frames: Vec<Vec<u8>>,
    }

    impl Link for Echo {
        fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
            self.frames.insert(0, frame.to_vec());
            Ok(())
        }

        fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
            Ok(self.frames.pop().map(|frame| {
                buf[..frame.len()].copy_from_slice(&frame);
                frame.len()
            }))
        }
    }

    #[test]
    fn private_mac_link_skips_frames_of_other_programs() {
        let mut other = vec![0x10; 60];
        other[TAIL].copy_from_slice(&[0x10, 0x20]);
        let echo = Echo {
            frames: vec![other.clone(), other],
        };
        let mut link = PrivateMacLink::new(Box::new(echo), 0x1234);
        let mine = [0x10; 60];
        link.send(&mine).expect("sent");
        let mut buf = [0; MAX_FRAME];
        assert_eq!(link.recv(&mut buf), Ok(Some(60)));
        assert_eq!(buf[..60], mine, "as it was sent");
        assert_eq!(link.recv(&mut buf), Ok(None));
        assert_eq!(link.stats().foreign, 2);
        assert_eq!(
            link.send(&[0; MAX_FRAME + 1]),
            Err(LinkError::TooLong(MAX_FRAME + 1))
        );
    }

    #[test]
    fn private_mac_link_sends_from_its_own_address() {
        let mut link = PrivateMacLink::new(Box::new(Echo::default()), 0x1234);
        link.send(&[0x10; 14]).expect("sent");
        let mut expected = [0x10; 14];
        expected[TAIL].copy_from_slice(&[0x34, 0x30]);
        let mut buf = [0; MAX_FRAME];
        // Checked below.
        let len = link.link.recv(&mut buf).expect("there");
        assert_eq!(len, Some(14));
        assert_eq!(buf[..14], expected);
    }
}
