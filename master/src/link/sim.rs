//! The simulated segment as a link, in the same thread and on the same clock.

use ecaxis_sim::{FrameOutcome, Nic, Segment};

use super::filter::{LinkStats, ReceivedFrame, classify_frame};
use super::redundant::{End, RingEnds};
use super::{FrameQueue, Link, LinkError, MAX_FRAME, Nanos};
use crate::clock;

/// The value of an input of a simulated I/O device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SimInput {
    /// The position of the device on the bus.
    pub position: usize,
    pub index: u16,
    pub sub: u8,
    /// The bits of the value.
    pub value: i64,
}

/// Sends values to the inputs of the simulated bus. Full if the bus carries no frames.
pub type SimInputSender = rtrb::Producer<SimInput>;

/// The maximum of values that wait for the next frame.
const INPUTS: usize = 256;

/// The maximum of frames in flight.
const IN_FLIGHT: usize = 64;

/// Carries frames through a [`Segment`] and returns them at their arrival time. The fault script
/// may make them late, reordered or duplicated.
#[derive(Debug)]
pub struct SimLink {
    segment: Segment,
    /// The clock's time at the segment's time zero.
    start: Nanos,
    /// The frames on their way to each port of the MainDevice.
    queues: [FrameQueue; 2],
    stats: LinkStats,
    inputs: rtrb::Consumer<SimInput>,
    sender: Option<SimInputSender>,
}

impl SimLink {
    /// Creates the link. The segment's time starts now.
    #[must_use]
    pub fn new(segment: Segment) -> Self {
        let (sender, inputs) = rtrb::RingBuffer::new(INPUTS);
        Self {
            inputs,
            sender: Some(sender),
            segment,
            start: clock::now(),
            queues: [FrameQueue::new(IN_FLIGHT), FrameQueue::new(IN_FLIGHT)],
            stats: LinkStats::default(),
        }
    }

    #[must_use]
    pub fn segment(&self) -> &Segment {
        &self.segment
    }

    pub fn segment_mut(&mut self) -> &mut Segment {
        &mut self.segment
    }

    fn send_from(&mut self, from: Nic, frame: &[u8]) -> Result<(), LinkError> {
        let now = clock::now().saturating_sub(self.start);
        while let Ok(input) = self.inputs.pop() {
            if let Some(device) = self.segment.device_mut(input.position) {
                device.set_input(input.index, input.sub, input.value);
            }
        }
        let [first, second] = &mut self.queues;
        // The frame waits where it was sent, until its destination is known.
        let (own, other) = match from {
            Nic::Primary => (first, second),
            Nic::Secondary => (second, first),
        };
        let slot = own.store(frame)?;
        if let FrameOutcome::Back { at, nic, again } =
            self.segment.transit_from(from, slot.frame(), now)
        {
            let arrivals = [Some(at), again].into_iter().flatten();
            let arrivals = arrivals.map(|at| at.saturating_add(self.start));
            let copy = slot.clone();
            let queue = if nic == from { own } else { other };
            for at in arrivals {
                // A copy without a free slot is lost.
                if let Some(slot) = queue.vacant() {
                    *slot = copy.clone();
                    queue.push(at);
                }
            }
        }
        if let Some((_, frame)) = self.segment.take_overheard() {
            // Rejected frames are counted here and never delivered.
            let seen = ReceivedFrame {
                frame: &frame,
                wire_len: frame.len(),
                status: 0,
                packet_type: libc::PACKET_BROADCAST,
            };
            if let Err(refused) = classify_frame(&seen) {
                self.stats.count(refused);
            }
        }
        Ok(())
    }
}

impl Link for SimLink {
    fn send(&mut self, frame: &[u8]) -> Result<(), LinkError> {
        self.send_from(Nic::Primary, frame)
    }

    fn recv(&mut self, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        Ok(self.queues[0].receive(clock::now(), buf))
    }

    fn main_devices(&self) -> u64 {
        self.stats.main_devices
    }

    fn stats(&mut self) -> LinkStats {
        self.stats
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.queues[0].next_due()
    }

    fn take_sim_inputs(&mut self) -> Option<SimInputSender> {
        self.sender.take()
    }
}

/// Both ends of a simulated ring.
#[derive(Debug)]
pub struct SimRing(pub SimLink);

impl RingEnds for SimRing {
    fn send(&mut self, from: End, frame: &[u8]) -> Result<(), LinkError> {
        let nic = match from {
            End::First => Nic::Primary,
            End::Second => Nic::Secondary,
        };
        self.0.send_from(nic, frame)
    }

    fn recv(&mut self, at: End, buf: &mut [u8; MAX_FRAME]) -> Result<Option<usize>, LinkError> {
        Ok(self.0.queues[at as usize].receive(clock::now(), buf))
    }

    fn next_arrival(&self) -> Option<Nanos> {
        self.0.queues.iter().filter_map(FrameQueue::next_due).min()
    }

    fn main_devices(&self) -> u64 {
        self.0.stats.main_devices
    }

    fn stats(&mut self) -> LinkStats {
        self.0.stats
    }

    fn take_sim_inputs(&mut self) -> Option<SimInputSender> {
        self.0.sender.take()
    }
}

#[cfg(test)]
mod tests {
    use ecaxis_sim::frame::FrameBuilder;
    use ecaxis_sim::{DeviceOptions, FaultScript, SegmentOptions, SimDevice};

    use super::*;
    use crate::clock::Clock;

    /// Sends `frames` frames, 10 µs apart, and returns the order in which they come back.
    fn order(script: &str, frames: u8) -> Vec<u8> {
        let script = FaultScript::parse(script).expect("script");
        std::thread::spawn(move || {
            Clock::Virtual.enter();
            let device = ecaxis_esi::model::Device::default();
            let device = SimDevice::from_esi(&device, &[], DeviceOptions::default());
            let devices = vec![device.expect("device")];
            let mut segment = Segment::new(devices, SegmentOptions::default());
            segment.set_faults(script);
            let mut link = SimLink::new(segment);
            let mut buf = [0; MAX_FRAME];
            let mut seen = Vec::new();
            for n in 0..frames {
                let frame = FrameBuilder::default().datagram(7, 0, 0, &[0]);
                let mut frame = frame.build();
                frame[17] = n;
                link.send(&frame).expect("room");
                Clock::Virtual.sleep_until(clock::now() + 10_000, 0);
                while link.recv(&mut buf).expect("simulated").is_some() {
                    seen.push(buf[17]);
                }
            }
            while let Some(at) = link.next_arrival() {
                assert_eq!(link.recv(&mut buf), Ok(None), "not before its time");
                Clock::Virtual.sleep_until(at, 0);
                link.recv(&mut buf).expect("simulated").expect("a frame");
                seen.push(buf[17]);
            }
            seen
        })
        .join()
        .expect("thread")
    }

    #[test]
    fn frames_come_back_in_the_order_of_their_arrival() {
        assert_eq!(order("", 4), [0, 1, 2, 3]);
        let late = "[[fault]]\nkind = \"frame-delay\"\ncount = 1\ndelay = \"25us\"\n";
        assert_eq!(order(late, 5), [1, 2, 0, 3, 4]);
    }

    #[test]
    fn duplicated_frame_comes_back_twice() {
        let twice = "[[fault]]\nkind = \"frame-duplicate\"\ncount = 1\n";
        assert_eq!(order(twice, 3), [0, 0, 1, 2]);
    }

    #[test]
    fn all_slots_hold_frames_and_copies() {
        let script = "[[fault]]\nkind = \"frame-delay\"\nprobability = 1.0\ndelay = \"1s\"\n\
                      [[fault]]\nkind = \"frame-duplicate\"\nprobability = 1.0\n";
        let seen = order(script, 32);
        // 32 frames and their copies fill 64 slots.
        assert_eq!(seen.len(), IN_FLIGHT);
        assert_eq!(seen[..4], [0, 0, 1, 1]);
    }
}
