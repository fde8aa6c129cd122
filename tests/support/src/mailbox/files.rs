//! The file server of the tests, written from ETG.1000.6 §5.8 independently of the client.

use std::collections::BTreeMap;

/// Deviations of the file server from the standard.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Manner {
    /// Answers packet n (0: the request) with BUSY this many times.
    Busy(u32, u32),
    /// Refuses packet n (0: the request) with this code and this text.
    Refuse(u32, u32, &'static [u8]),
    /// Acknowledges packet n with another number.
    Misnumber(u32, u32),
    /// Acknowledges the previous packet again, then packet n.
    StaleAck(u32),
    /// Sends packet n this many times more than it should.
    DataAgain(u32, u32),
    /// Answers packet n (0: the request) with this opcode and with data.
    Opcode(u32, u8),
}

#[derive(Debug)]
enum Transfer {
    In {
        name: String,
        data: Vec<u8>,
        packet: u32,
    },
    Out {
        data: Vec<u8>,
        packet: u32,
    },
}

#[derive(Debug, Default)]
pub struct Files {
    pub stored: BTreeMap<String, Vec<u8>>,
    pub password: u32,
    pub manners: Vec<Manner>,
    /// Error codes that the client sent.
    pub reported: Vec<u32>,
    transfer: Option<Transfer>,
}

fn message(opcode: u8, number: u32, data: &[u8]) -> Vec<u8> {
    [&[opcode, 0], &number.to_le_bytes()[..], data].concat()
}

impl Files {
    pub fn is_idle(&self) -> bool {
        self.transfer.is_none()
    }

    /// `room` is the number of bytes behind a mailbox header, in both directions.
    pub fn answer(&mut self, body: &[u8], room: usize) -> Vec<Vec<u8>> {
        let full = room - 6;
        let number = u32::from_le_bytes(body[2..6].try_into().unwrap());
        let rest = &body[6..];
        let at = if body[0] <= 2 { 0 } else { number };
        let mut before = Vec::new();
        for manner in &mut self.manners {
            match manner {
                Manner::Busy(n, times) if *n == at && *times > 0 => {
                    *times -= 1;
                    let text = &b"wait"[..];
                    return vec![message(6, 30 | 100 << 16, text)];
                }
                Manner::Refuse(n, code, text) if *n == at => {
                    self.transfer = None;
                    return vec![message(5, *code, text)];
                }
                Manner::Misnumber(n, other) if *n == at => return vec![message(4, *other, &[])],
                Manner::Opcode(n, opcode) if *n == at => return vec![message(*opcode, at, b"?")],
                Manner::StaleAck(n) if *n == at => before.push(message(4, at - 1, &[])),
                Manner::DataAgain(n, times) if *n == at && body[0] == 4 && *times > 0 => {
                    *times -= 1;
                    let Some(Transfer::Out { data, packet }) = &self.transfer else {
                        panic!("nothing is being read")
                    };
                    return vec![message(3, *packet, &data[..full.min(data.len())])];
                }
                _ => {}
            }
        }
        before.extend(self.duty(body[0], number, rest, full));
        before
    }

    fn duty(&mut self, opcode: u8, number: u32, rest: &[u8], full: usize) -> Option<Vec<u8>> {
        match (opcode, self.transfer.take()) {
            (1 | 2, _) if self.password != 0 && number != self.password => {
                Some(message(5, 0x800a, b"password?"))
            }
            (1, None) => {
                let name = String::from_utf8(rest.to_vec()).unwrap();
                let Some(data) = self.stored.get(&name).cloned() else {
                    return Some(message(5, 0x8001, &[]));
                };
                let first = data[..full.min(data.len())].to_vec();
                self.transfer = Some(Transfer::Out { data, packet: 1 });
                Some(message(3, 1, &first))
            }
            (2, None) => {
                self.transfer = Some(Transfer::In {
                    name: String::from_utf8(rest.to_vec()).unwrap(),
                    data: Vec::new(),
                    packet: 1,
                });
                Some(message(4, 0, &[]))
            }
            (
                3,
                Some(Transfer::In {
                    name,
                    mut data,
                    packet,
                }),
            ) if packet == number => {
                data.extend_from_slice(rest);
                if rest.len() < full {
                    self.stored.insert(name, data);
                } else {
                    let packet = packet + 1;
                    self.transfer = Some(Transfer::In { name, data, packet });
                }
                Some(message(4, number, &[]))
            }
            (4, Some(Transfer::Out { mut data, packet })) if packet == number => {
                if data.len() < full {
                    return None;
                }
                data.drain(..full);
                let next = data[..full.min(data.len())].to_vec();
                let packet = packet + 1;
                self.transfer = Some(Transfer::Out { data, packet });
                Some(message(3, packet, &next))
            }
            (5, _) => {
                self.reported.push(number);
                None
            }
            (3 | 4, Some(_)) => Some(message(5, 0x8005, &[])),
            _ => Some(message(5, 0x8004, b"not now")),
        }
    }
}
