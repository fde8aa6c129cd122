//! CoE answers as bytes, for a server of an object dictionary.

use alloc::vec::Vec;

use super::coe::{
    ABORT, Answer, EXPEDITED, Fragment, SEGMENT_MIN, SERVICE_SDO_INFORMATION, SERVICE_SDO_REQUEST,
    SERVICE_SDO_RESPONSE, SIZE_INDICATED, TOGGLE, unused,
};

/// The fragment announces further ones.
const INCOMPLETE: u8 = 0x80;

impl Answer<'_> {
    /// Returns the message without the mailbox header.
    #[must_use]
    pub fn body(&self) -> Vec<u8> {
        let service = match self {
            // ETG.1000.6 clause 5.6.2.7: an abort has the service of a request in both directions.
            Self::Abort { .. } => SERVICE_SDO_REQUEST,
            _ => SERVICE_SDO_RESPONSE,
        };
        let mut out = Vec::from((service << 12).to_le_bytes());
        let mut initiate = |command: u8, index: u16, sub: u8, rest: &[u8]| {
            out.push(command);
            out.extend_from_slice(&index.to_le_bytes());
            out.push(sub);
            out.extend_from_slice(rest);
        };
        match *self {
            Self::Abort { index, sub, code } => initiate(ABORT, index, sub, &code.to_le_bytes()),
            Self::Download { index, sub } => initiate(0x60, index, sub, &[0; 4]),
            Self::Upload {
                index,
                sub,
                size,
                data,
            } if size == data.len() && (1..=4).contains(&size) => {
                let command = 0x40 | EXPEDITED | SIZE_INDICATED | unused(4, size) << 2;
                initiate(command, index, sub, data);
                out.resize(2 + 8, 0);
            }
            Self::Upload {
                index,
                sub,
                size,
                data,
            } => {
                let size = u32::try_from(size).unwrap_or(u32::MAX);
                initiate(0x40 | SIZE_INDICATED, index, sub, &size.to_le_bytes());
                out.extend_from_slice(data);
            }
            Self::UploadSegment { toggle, last, data } => {
                let toggle = if toggle { TOGGLE } else { 0 };
                out.push(unused(SEGMENT_MIN, data.len()) << 1 | u8::from(last) | toggle);
                out.extend_from_slice(data);
                out.resize(out.len().max(2 + 1 + SEGMENT_MIN), 0);
            }
            Self::DownloadSegment { toggle } => {
                out.push(0x20 | if toggle { TOGGLE } else { 0 });
                out.resize(2 + 1 + SEGMENT_MIN, 0);
            }
        }
        out
    }
}

impl Fragment<'_> {
    /// Returns the message without the mailbox header.
    #[must_use]
    pub fn body(&self) -> Vec<u8> {
        let mut out = Vec::from((SERVICE_SDO_INFORMATION << 12).to_le_bytes());
        let incomplete = if self.left > 0 { INCOMPLETE } else { 0 };
        out.extend_from_slice(&[self.opcode | incomplete, 0]);
        out.extend_from_slice(&self.left.to_le_bytes());
        out.extend_from_slice(self.data);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::super::coe::Message;
    use super::*;

    /// Parses a body as the message of a mailbox.
    fn parsed(body: &[u8]) -> Vec<u8> {
        let length = u16::try_from(body.len()).unwrap().to_le_bytes();
        [&length[..], &[0, 0, 0, 0x13], body].concat()
    }

    #[test]
    fn answers_round_trip() {
        let data = [1, 2, 3, 4, 5, 6, 7, 8, 9];
        let (index, sub) = (0x8001, 3);
        let mut answers = alloc::vec![
            Answer::Abort {
                index,
                sub,
                code: 0x0602_0000,
            },
            Answer::Download { index, sub },
        ];
        for size in 0..=data.len() {
            let data = &data[..size];
            for size in [size, 1000] {
                answers.push(Answer::Upload {
                    index,
                    sub,
                    size,
                    data,
                });
            }
            for (toggle, last) in [(false, false), (true, true)] {
                answers.push(Answer::UploadSegment { toggle, last, data });
                answers.push(Answer::DownloadSegment { toggle });
            }
        }
        for answer in answers {
            let mailbox = parsed(&answer.body());
            assert_eq!(Message::parse(&mailbox), Ok(Message::Sdo(answer)));
        }
        for left in [0, 2] {
            let fragment = Fragment {
                opcode: 4,
                left,
                data: &data,
            };
            let mailbox = parsed(&fragment.body());
            assert_eq!(Message::parse(&mailbox), Ok(Message::Information(fragment)));
        }
    }
}
