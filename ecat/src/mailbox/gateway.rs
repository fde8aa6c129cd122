//! Telegrams of a mailbox gateway (ETG.8200): a mailbox message behind an EtherCAT header, over UDP
//! or TCP.
//!
//! ```
//! use ecaxis_ecat::mailbox::gateway::Telegram;
//!
//! // An upload of 0xF980:02 from the SubDevice with the station address 1001.
//! let frame = [
//!     0x10, 0x50, 0x0a, 0, 0xe9, 0x03, 0, 0x23, 0, 0x20, 0x41, 0x80, 0xf9, 2, 0, 0, 0, 0,
//! ];
//! let telegram = Telegram::parse(&frame)?;
//! assert_eq!((telegram.station, telegram.protocol, telegram.counter), (1001, 3, 2));
//! let mut bytes = Vec::new();
//! telegram.emit_frame(&mut bytes);
//! assert_eq!(bytes, frame);
//! # Ok::<(), ecaxis_ecat::mailbox::DecodeError>(())
//! ```

use alloc::vec::Vec;

use super::{DecodeError, Encode, HEADER, Mailbox};

/// The port of UDP and TCP.
pub const PORT: u16 = 34_980;
/// The length in bytes of the EtherCAT header.
pub const FRAME_HEADER: usize = 2;
/// The longest frame: the length field of the EtherCAT header has 11 bits.
pub const MAX_FRAME: usize = FRAME_HEADER + LENGTH as usize;

/// The bits of the length in the EtherCAT header.
const LENGTH: u16 = 0x07ff;
/// The type of a mailbox telegram in the EtherCAT header.
const TYPE_MAILBOX: u16 = 5;

/// One mailbox message with its station address.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Telegram<'a> {
    /// The configured address of the SubDevice; 0 is the MainDevice.
    pub station: u16,
    /// Channel (bits 0 to 5) and priority (bits 6 and 7).
    pub channel: u8,
    /// The protocol, such as [`super::TYPE_COE`].
    pub protocol: u8,
    /// The counter: 1 to 7, or 0.
    pub counter: u8,
    /// The message without the header.
    pub body: &'a [u8],
}

/// Returns the length in bytes of what follows an EtherCAT header.
///
/// # Errors
/// [`DecodeError::FrameType`] if a mailbox telegram does not follow.
pub const fn frame_length(header: [u8; FRAME_HEADER]) -> Result<usize, DecodeError> {
    let header = u16::from_le_bytes(header);
    match header >> 12 {
        TYPE_MAILBOX => Ok((header & LENGTH) as usize),
        other => Err(DecodeError::FrameType(other)),
    }
}

impl<'a> Telegram<'a> {
    /// Parses a frame. Bytes behind the telegram are ignored.
    ///
    /// # Errors
    /// [`DecodeError`] if the frame is inconsistent.
    pub fn parse(frame: &'a [u8]) -> Result<Self, DecodeError> {
        let short = DecodeError::Short {
            what: "a gateway frame",
            length: frame.len(),
        };
        let (header, rest) = frame.split_first_chunk().ok_or(short)?;
        let telegram = rest.get(..frame_length(*header)?).ok_or(short)?;
        let Mailbox {
            protocol,
            counter,
            body,
        } = Mailbox::parse(telegram)?;
        let [_, _, low, high, channel, ..] = telegram else {
            return Err(short);
        };
        Ok(Self {
            station: u16::from_le_bytes([*low, *high]),
            channel: *channel,
            protocol,
            counter,
            body,
        })
    }

    /// Writes the frame to `out`. Of a body that is too long for a frame, the end is missing.
    pub fn emit_frame(&self, out: &mut Vec<u8>) {
        let body = self.body.get(..MAX_FRAME - FRAME_HEADER - HEADER);
        let body = body.unwrap_or(self.body);
        let length = u16::try_from(HEADER + body.len()).unwrap_or(LENGTH);
        out.clear();
        out.extend_from_slice(&(TYPE_MAILBOX << 12 | length).to_le_bytes());
        self.emit_header(body.len(), self.station, self.counter, out);
        out.extend_from_slice(body);
    }

    fn emit_header(&self, length: usize, station: u16, counter: u8, out: &mut Vec<u8>) {
        let length = u16::try_from(length).unwrap_or(u16::MAX);
        out.extend_from_slice(&length.to_le_bytes());
        out.extend_from_slice(&station.to_le_bytes());
        out.extend_from_slice(&[self.channel, self.protocol & 0x0f | (counter & 7) << 4]);
    }
}

/// The message for the SubDevice: its address field is that of the MainDevice.
impl Encode for Telegram<'_> {
    fn emit(&self, counter: u8, mailbox: u16, out: &mut Vec<u8>) {
        out.clear();
        self.emit_header(self.body.len(), 0, counter, out);
        out.extend_from_slice(self.body);
        out.resize(usize::from(mailbox), 0);
    }
}

#[cfg(test)]
mod tests {
    use alloc::vec;
    use alloc::vec::Vec;

    use super::super::coe::Answer;
    use super::*;

    /// An answer that TwinSAFE Loader received through a gateway.
    const ANSWER: [u8; 18] = [
        0x10, 0x50, 0x0a, 0, 0xe9, 0x03, 0, 0x13, 0, 0x30, 0x43, 0x80, 0xf9, 2, 0xea, 0x82, 0x1e, 0,
    ];

    #[test]
    fn recorded_answer_is_emitted_from_its_mailbox_message() {
        let telegram = Telegram::parse(&ANSWER).unwrap();
        let data = [0xea, 0x82, 0x1e, 0];
        let upload = Answer::Upload {
            index: 0xf980,
            sub: 2,
            size: 4,
            data: &data,
        };
        let mailbox = &ANSWER[FRAME_HEADER..];
        let parsed = super::super::coe::Message::parse(mailbox).unwrap();
        assert_eq!(parsed, super::super::coe::Message::Sdo(upload));
        assert_eq!(telegram.counter, 1);
        let mut frame = vec![0xa5; 5];
        telegram.emit_frame(&mut frame);
        assert_eq!(frame, ANSWER);
    }

    #[test]
    fn message_for_a_device_has_its_own_counter_and_the_length_of_the_mailbox() {
        let telegram = Telegram::parse(&ANSWER).unwrap();
        let mut mailbox = Vec::new();
        telegram.emit(6, 24, &mut mailbox);
        assert_eq!(mailbox[..6], [10, 0, 0, 0, 0, 0x63]);
        assert_eq!(mailbox[6..16], ANSWER[8..]);
        assert_eq!(mailbox[16..], [0; 8]);
    }

    #[test]
    fn inconsistent_frames_are_errors() {
        let with = |place: usize, byte: u8| {
            let mut frame = ANSWER;
            frame[place] = byte;
            frame
        };
        for length in 0..ANSWER.len() {
            assert!(Telegram::parse(&ANSWER[..length]).is_err(), "{length}");
        }
        // Another type, a telegram shorter than its message, and one that ends within its header.
        assert_eq!(
            Telegram::parse(&with(1, 0x10)),
            Err(DecodeError::FrameType(1))
        );
        assert!(Telegram::parse(&with(0, 0x0f)).is_err());
        assert!(Telegram::parse(&with(0, 5)).is_err());
        assert!(Telegram::parse(&with(2, 0x0b)).is_err());
        let padded = [&ANSWER[..], &[0; 46]].concat();
        assert_eq!(Telegram::parse(&padded), Telegram::parse(&ANSWER));
    }

    #[test]
    fn body_longer_than_a_frame_is_cut() {
        let body = vec![7; 5000];
        let telegram = Telegram {
            body: &body,
            ..Telegram::parse(&ANSWER).unwrap()
        };
        let mut frame = Vec::new();
        telegram.emit_frame(&mut frame);
        assert_eq!(frame.len(), MAX_FRAME);
        let parsed = Telegram::parse(&frame).unwrap();
        assert_eq!(parsed.body, &body[..MAX_FRAME - 8]);
    }
}
