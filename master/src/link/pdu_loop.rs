//! Connects ethercrab to a link. ethercrab builds its own frames with one datagram each. The owner
//! of the link moves them: the pump during bring-up, the cycle afterwards. Both join the datagrams
//! that wait: the pump all of them into as few Ethernet frames as possible, the cycle some of them
//! into one.

use std::future::Future;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use ethercrab::{MainDevice, MainDeviceConfig, PduRx, PduStorage, PduTx, RetryBehaviour, Timeouts};

use super::joined_frame::{JoinedFrame, datagrams};
use super::scan_answers::ScanAnswers;
use super::{Link, LinkError, MAX_DATA, MAX_FRAME};
use crate::clock::{self, Clock, Nanos};

/// EtherType of EtherCAT frames.
pub const ETHERCAT: [u8; 2] = [0x88, 0xa4];

/// Last byte of the source MAC of ethercrab's frames; cyclic frames have another one, see
/// `rt::exchange`.
const ETHERCRAB_MAC_TAIL: u8 = 0x10;

/// The maximum of ethercrab frames in flight; each awaited datagram takes one. As many datagrams of
/// 10 bytes fill an Ethernet frame.
const FRAMES: usize = 64;
/// The maximum of datagrams in flight of one [`crate::datagram::DatagramClient`] during bring-up.
/// The remaining frames are ethercrab's own and those of clients before and after.
pub(crate) const MAX_DATAGRAMS: u64 = 48;
/// The maximum of datagrams in the frame of a cycle.
pub(crate) const MAX_JOINED: u64 = 8;
/// Bytes per frame: the maximum, so that the largest mailbox fits.
const FRAME_BYTES: usize = PduStorage::element_size(MAX_DATA as usize);
const _: () = assert!(FRAME_BYTES == MAX_FRAME);

/// The largest step of virtual time while no frame is in flight.
const IDLE_STEP: Nanos = 20_000;

/// The minimum timeout of a datagram; a busy host answers late.
const PDU_TIMEOUT: Duration = Duration::from_millis(30);

/// Both ends of ethercrab's PDU loop.
pub struct PduLoop {
    tx: PduTx<'static>,
    rx: PduRx<'static>,
    joined: JoinedFrame,
    /// Answers reads of EEPROMs in place of their devices.
    pub scan_answers: Arc<ScanAnswers>,
    /// Frames that ethercrab rejected: late, unknown or damaged.
    pub refused: u64,
}

impl std::fmt::Debug for PduLoop {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Port")
            .field("refused", &self.refused)
            .finish_non_exhaustive()
    }
}

/// Returns a MainDevice and the PDU loop that carries its frames. The storage lives as long as the
/// process: a process drives one bus once, and ethercrab's futures borrow the storage for
/// `'static`.
///
/// During operation, a datagram leaves in one cycle and returns in the next. Its timeout must
/// therefore exceed a few cycles. `pre_op` is the time-out of each SubDevice to PreOp in ethercrab's
/// part of the bring-up.
#[must_use]
pub fn main_device(cycle_ns: Nanos, pre_op: Duration) -> (&'static MainDevice<'static>, PduLoop) {
    let storage: &'static PduStorage<FRAMES, FRAME_BYTES> = Box::leak(Box::new(PduStorage::new()));
    let Ok((tx, rx, pdu_loop)) = storage.try_split() else {
        unreachable!("a new storage splits once");
    };
    let timeouts = Timeouts {
        pdu: Duration::from_nanos(cycle_ns.saturating_mul(5)).max(PDU_TIMEOUT),
        // Timeouts of whole operations must exceed the repetition of a lost datagram.
        eeprom: Duration::from_secs(1),
        state_transition: pre_op,
        wait_loop_delay: Duration::from_micros(200),
        ..Timeouts::default()
    };
    let config = MainDeviceConfig {
        // `bringup::clocks` compensates the drift while the devices are configured.
        dc_static_sync_iterations: 0,
        retry_behaviour: RetryBehaviour::Count(3),
    };
    let device = Box::leak(Box::new(MainDevice::new(pdu_loop, timeouts, config)));
    let port = PduLoop {
        tx,
        rx,
        joined: JoinedFrame::default(),
        scan_answers: Arc::default(),
        refused: 0,
    };
    (device, port)
}

impl PduLoop {
    /// Sends at most one frame, with up to 8 of the datagrams that ethercrab has ready.
    /// RT.
    pub fn send_one(&mut self, link: &mut dyn Link) -> Result<(), LinkError> {
        for _ in 0..MAX_JOINED {
            let Some(frame) = self.tx.next_sendable_frame() else {
                break;
            };
            // ethercrab keeps a datagram that does not fit for the next cycle.
            let fits = frame.send_blocking(|bytes| match self.joined.append(bytes) {
                true => Ok(bytes.len()),
                false => Err(ethercrab::error::Error::SendFrame),
            });
            if fits.is_err() {
                break;
            }
        }
        self.joined.flush(link)
    }

    /// Sends the datagrams of all frames that ethercrab has ready, in as few frames as possible,
    /// except for those that are answered at once.
    fn send_all(&mut self, link: &mut dyn Link) -> Result<Moved, LinkError> {
        let mut moved = Moved::default();
        while let Some(frame) = self.tx.next_sendable_frame() {
            let mut flushed = Ok(());
            let mut answer = None;
            let _ = frame.send_blocking(|bytes| {
                answer = self.scan_answers.answer(bytes);
                if answer.is_none() && !self.joined.append(bytes) {
                    flushed = self.joined.flush(link);
                    self.joined.append(bytes);
                }
                Ok(bytes.len())
            });
            flushed?;
            match answer {
                Some(frame) => {
                    self.receive(&frame);
                    moved.answered = true;
                }
                None => moved.sent = true,
            }
        }
        self.joined.flush(link)?;
        Ok(moved)
    }

    /// Passes the datagrams of a received frame to ethercrab if they are ethercrab's. Datagrams that
    /// ethercrab rejects (late or damaged answers) are counted and dropped. RT.
    pub fn receive(&mut self, frame: &[u8]) {
        if !belongs_to_ethercrab(frame) {
            return;
        }
        for datagram in datagrams(frame) {
            if self.rx.receive_frame(datagram.frame()).is_err() {
                self.refused += 1;
            }
        }
    }
}

/// What became of the datagrams that were ready.
#[derive(Debug, Clone, Copy, Default)]
struct Moved {
    sent: bool,
    answered: bool,
}

/// True if a frame is EtherCAT with ethercrab's source address.
fn belongs_to_ethercrab(frame: &[u8]) -> bool {
    frame.get(12..14) == Some(&ETHERCAT[..]) && frame.get(11) == Some(&ETHERCRAB_MAC_TAIL)
}

/// Runs `future` to completion while carrying ethercrab's frames. The executor of the bring-up.
pub fn drive_pdu_loop<F: Future>(
    port: &mut PduLoop,
    link: &mut dyn Link,
    clock: Clock,
    future: F,
) -> Result<F::Output, LinkError> {
    let mut future = pin!(future);
    let mut context = Context::from_waker(Waker::noop());
    let mut buf = [0; MAX_FRAME];
    let mut idle: u32 = 0;
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
            return Ok(output);
        }
        let Moved { sent, answered } = port.send_all(link)?;
        let mut moved = sent;
        while let Some(len) = link.recv(&mut buf)? {
            port.receive(&buf[..len]);
            moved = true;
        }
        if answered {
            continue;
        }
        idle = if moved { 0 } else { idle.saturating_add(1) };
        match clock {
            Clock::Virtual => {
                let next = link
                    .next_arrival()
                    .unwrap_or_else(|| clock::now() + IDLE_STEP);
                clock.relax(next);
            }
            // Frames come back within microseconds, but a working device takes milliseconds.
            Clock::Real if idle > 2_000 => std::thread::sleep(Duration::from_micros(50)),
            Clock::Real => std::hint::spin_loop(),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use super::*;
    use crate::datagram::DatagramClient;
    use crate::mailbox::MailboxTransport;

    /// A link that keeps what it sends.
    #[derive(Debug, Default)]
    struct Kept(VecDeque<Vec<u8>>);

    impl Link for Kept {
        fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
            self.0.push_back(frame.to_vec());
            Ok(())
        }

        fn recv(&mut self, _: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
            Ok(None)
        }

        fn next_arrival(&self) -> Option<Nanos> {
            None
        }
    }

    /// Returns the datagrams of each frame that leaves for reads of these lengths.
    fn frames_of(lengths: &[usize]) -> Vec<usize> {
        let (device, mut port) = main_device(1_000_000, Duration::from_secs(1));
        let client = DatagramClient::new(device);
        let mut buffers: Vec<_> = lengths.iter().map(|len| vec![0; *len]).collect();
        let mut context = Context::from_waker(Waker::noop());
        let reads = buffers.iter_mut().map(|buf| client.read(0x1000, 0, buf));
        let mut reads: Vec<_> = reads.map(Box::pin).collect();
        for read in &mut reads {
            assert!(read.as_mut().poll(&mut context).is_pending());
        }
        let mut link = Kept::default();
        let mut counts = Vec::new();
        loop {
            port.send_one(&mut link).expect("kept");
            match link.0.pop_front() {
                Some(frame) => counts.push(datagrams(&frame).count()),
                None => return counts,
            }
            assert!(link.0.is_empty(), "one frame per cycle");
        }
    }

    #[test]
    fn one_frame_per_cycle_carries_the_datagrams_that_wait() {
        assert_eq!(frames_of(&[]), [0; 0]);
        assert_eq!(frames_of(&[2]), [1]);
        assert_eq!(frames_of(&[8; 19]), [8, 8, 3]);
        assert_eq!(frames_of(&[1486, 2, 1400, 61]), [1, 2, 1]);
    }
}
