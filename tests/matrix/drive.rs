//! What a drive received and reported in each cycle, in the terms of the rules.

use super::wire::Cycle;

/// The place and the kind of an axis' process data.
#[derive(Debug, Clone, Copy)]
pub enum Codec {
    /// Objects of CiA 402 in order.
    Objects {
        outputs: &'static [u16],
        inputs: &'static [u16],
    },
    /// A node behind a gateway: 0x6040 and 0x2062; 0x6041 and 0x6064, from these bytes.
    Node { outputs: usize, inputs: usize },
    /// A channel of a Sercos drive: S-0-0134 and S-0-0047; S-0-0135 and S-0-0051, from these bytes.
    Sercos { outputs: usize, inputs: usize },
}

/// The command to the power stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Power {
    Operate,
    /// The drive stops by itself, then has no power.
    QuickStop,
    Off,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    pub power: Power,
    /// The word as sent, without the toggle bit of a Sercos drive.
    pub word: u16,
    pub mode: Option<i8>,
    pub position: Option<i32>,
    pub velocity: Option<i32>,
    pub profile_velocity: Option<u32>,
    /// 0x6083 and 0x6084.
    pub ramps: [Option<u32>; 2],
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Report {
    pub word: u16,
    /// The power stage works: Operation enabled, Quick stop active, Fault reaction active.
    pub powered: bool,
    pub enabled: bool,
    pub fault: bool,
    pub position: i32,
}

/// One cycle of an axis.
#[derive(Debug, Clone, Copy)]
pub struct Moment {
    /// The time of the frame in ns.
    pub at: u64,
    pub sent: Option<Sent>,
    /// The answer to this frame, if it came in time.
    pub report: Option<Report>,
}

/// Returns the size in bytes of a CiA 402 object (IEC 61800-7-201, table 1).
fn size(object: u16) -> usize {
    match object {
        0x6060 | 0x6061 => 1,
        0x6040 | 0x6041 | 0x6071 | 0x6077 | 0x60b8 | 0x60b9 => 2,
        _ => 4,
    }
}

fn find(objects: &[u16], wanted: u16, bytes: &[u8]) -> Option<[u8; 4]> {
    let mut at = 0;
    for &object in objects {
        let piece = bytes.get(at..at + size(object))?;
        if object == wanted {
            let mut value = [0; 4];
            value[..piece.len()].copy_from_slice(piece);
            return Some(value);
        }
        at += piece.len();
    }
    None
}

fn word(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?))
}

fn long(bytes: &[u8], at: usize) -> Option<i32> {
    Some(i32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

/// Commands of the Controlword (IEC 61800-7-201, table 27).
fn power(controlword: u16) -> Power {
    match controlword & 0x8f {
        0x0f => Power::Operate,
        word if word & 0x86 == 0x02 => Power::QuickStop,
        _ => Power::Off,
    }
}

/// States of the Statusword (IEC 61800-7-201, table 29).
fn report(statusword: u16, position: i32) -> Report {
    let state = statusword & 0x6f;
    let reaction = statusword & 0x4f == 0x0f;
    Report {
        word: statusword,
        powered: matches!(state, 0x27 | 0x07) || reaction,
        enabled: state == 0x27,
        fault: statusword & 0x08 != 0,
        position,
    }
}

impl Codec {
    fn sent(&self, bytes: &[u8]) -> Option<Sent> {
        let plain = |power, word, position| Sent {
            power,
            word,
            mode: None,
            position,
            velocity: None,
            profile_velocity: None,
            ramps: [None; 2],
        };
        Some(match *self {
            Self::Objects { outputs, .. } => {
                let long = |object| find(outputs, object, bytes).map(i32::from_le_bytes);
                let controlword = (long(0x6040)? & 0xffff) as u16;
                Sent {
                    mode: find(outputs, 0x6060, bytes).map(|value| value[0].cast_signed()),
                    velocity: long(0x60ff),
                    profile_velocity: long(0x6081).map(i32::cast_unsigned),
                    ramps: [0x6083, 0x6084].map(|object| long(object).map(i32::cast_unsigned)),
                    ..plain(power(controlword), controlword, long(0x607a))
                }
            }
            Self::Node { outputs, .. } => {
                let controlword = word(bytes, outputs)?;
                let position = long(bytes, outputs + 2);
                plain(power(controlword), controlword, position)
            }
            // IEC 61800-7-204, S-0-0134: drive on, enable, follow the command value.
            Self::Sercos { outputs, .. } => {
                let control = word(bytes, outputs)? & !(1 << 10);
                let power = match control >> 13 {
                    7 => Power::Operate,
                    3 => Power::QuickStop,
                    _ => Power::Off,
                };
                plain(power, control, long(bytes, outputs + 2))
            }
        })
    }

    fn report(&self, bytes: &[u8]) -> Option<Report> {
        Some(match *self {
            Self::Objects { inputs, .. } => {
                let long = |object| find(inputs, object, bytes).map(i32::from_le_bytes);
                report((long(0x6041)? & 0xffff) as u16, long(0x6064)?)
            }
            Self::Node { inputs, .. } => report(word(bytes, inputs)?, long(bytes, inputs + 2)?),
            // S-0-0135, bits 15 and 14: in operation; bit 13: error of class 1.
            Self::Sercos { inputs, .. } => {
                let status = word(bytes, inputs)?;
                let powered = status >> 14 == 3;
                let fault = status & 0x2000 != 0;
                Report {
                    word: status,
                    powered,
                    enabled: powered && !fault,
                    fault,
                    position: long(bytes, inputs + 2)?,
                }
            }
        })
    }

    /// Returns every cycle of the axis. A reply after `in_time` ns is none.
    pub fn moments(&self, cycles: &[Cycle], device: usize, in_time: u64) -> Vec<Moment> {
        let moment = |cycle: &Cycle| {
            let exchange = cycle.devices[device].as_ref();
            let answer = exchange.and_then(|of| of.answer.as_ref());
            let answer = answer.filter(|(back, _)| *back <= cycle.at + in_time);
            Moment {
                at: cycle.at,
                sent: exchange.and_then(|of| self.sent(&of.outputs)),
                report: answer.and_then(|(_, bytes)| self.report(bytes)),
            }
        };
        cycles.iter().map(moment).collect()
    }
}

impl std::fmt::Display for Moment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.4} s:", self.at as f64 * 1e-9)?;
        if let Some(sent) = &self.sent {
            write!(f, " sent {:04x}", sent.word)?;
            let position = sent.position.map(|value| ("position", value));
            let velocity = sent.velocity.map(|value| ("velocity", value));
            for (name, value) in position.into_iter().chain(velocity) {
                write!(f, " {name} {value}")?;
            }
        }
        match &self.report {
            Some(report) => write!(f, " | {:04x} at {}", report.word, report.position),
            None => f.write_str(" | no answer"),
        }
    }
}
