//! Set-points that pass between the cycle and other threads: those of axes to other machines, and
//! those of other machines to line shafts.
//!
//! A cell holds the newest point. Its writer never waits. A reader that meets a write keeps what it
//! read before.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering, fence};

use ecaxis_axis::setpoint::{LineShaftPoint, Motion};

/// The attempts to read a complete point.
const ATTEMPTS: usize = 4;

/// The newest point of a stream.
#[derive(Debug, Default)]
pub struct SetpointCell {
    /// Even while the words are complete.
    sequence: AtomicU64,
    /// 1 if there is a point, its stream, its instant, position, velocity and acceleration.
    words: [AtomicU64; 6],
}

impl SetpointCell {
    /// Creates a cell without a point, whose next stream is the one after `stream`.
    #[must_use]
    pub fn new(stream: u64) -> Self {
        let cell = Self::default();
        cell.words[1].store(stream, Ordering::Relaxed);
        cell
    }

    /// Writes a point; `None` removes it. Only one thread may write. RT: wait-free.
    pub fn write(&self, point: Option<LineShaftPoint>) {
        let Some(point) = point else {
            self.words[0].store(0, Ordering::Release);
            return;
        };
        let sequence = self.sequence.load(Ordering::Relaxed);
        self.sequence
            .store(sequence.wrapping_add(1), Ordering::Relaxed);
        fence(Ordering::Release);
        let motion = point.motion;
        let values = [
            1,
            point.stream,
            point.at_ns,
            motion.position.to_bits(),
            motion.velocity.to_bits(),
            motion.acceleration.to_bits(),
        ];
        for (word, value) in self.words.iter().zip(values) {
            word.store(value, Ordering::Relaxed);
        }
        self.sequence
            .store(sequence.wrapping_add(2), Ordering::Release);
    }

    /// Returns the stream of the last point.
    #[must_use]
    pub fn stream(&self) -> u64 {
        self.words[1].load(Ordering::Relaxed)
    }

    /// Copies the point to `to`; keeps `to` if a write is in progress. RT: wait-free.
    pub fn read(&self, to: &mut Option<LineShaftPoint>) {
        for _ in 0..ATTEMPTS {
            let before = self.sequence.load(Ordering::Acquire);
            let [there, stream, at_ns, position, velocity, acceleration] =
                [0, 1, 2, 3, 4, 5].map(|n: usize| self.words[n].load(Ordering::Relaxed));
            fence(Ordering::Acquire);
            if before.is_multiple_of(2) && self.sequence.load(Ordering::Relaxed) == before {
                *to = (there != 0).then_some(LineShaftPoint {
                    stream,
                    at_ns,
                    motion: Motion {
                        position: f64::from_bits(position),
                        velocity: f64::from_bits(velocity),
                        acceleration: f64::from_bits(acceleration),
                    },
                });
                return;
            }
        }
    }
}

/// The cells of a machine.
#[derive(Debug, Clone, Default)]
pub struct SetpointCells {
    /// The set-points of each axis; empty: no other machine needs them.
    pub axes: Box<[Arc<SetpointCell>]>,
    /// The newest point for each line shaft; empty: nothing feeds them.
    pub line_shafts: Box<[Arc<SetpointCell>]>,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All words of a point are of the same write.
    #[test]
    fn a_point_is_read_whole_or_not_at_all() {
        let point = |n: u64| LineShaftPoint {
            stream: n,
            at_ns: n,
            motion: Motion {
                position: n as f64,
                velocity: n as f64,
                acceleration: n as f64,
            },
        };
        let cell = Arc::new(SetpointCell::new(7));
        let mut read = None;
        cell.read(&mut read);
        assert_eq!((read, cell.stream()), (None, 7));
        let writer = Arc::clone(&cell);
        let writes =
            std::thread::spawn(move || (1..200_000).for_each(|n| writer.write(Some(point(n)))));
        let mut newest = 0;
        while !writes.is_finished() {
            cell.read(&mut read);
            if let Some(seen) = read {
                assert_eq!(seen, point(seen.stream));
                assert!(seen.stream >= newest);
                newest = seen.stream;
            }
        }
        writes.join().expect("ends");
        cell.read(&mut read);
        assert_eq!(read, Some(point(199_999)));
        cell.write(None);
        cell.read(&mut read);
        assert_eq!((read, cell.stream()), (None, 199_999));
    }
}
