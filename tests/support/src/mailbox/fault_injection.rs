//! Faults of a SubDevice or of the wire.

/// A fault and its time. Numbers count mailbox messages (or accesses) from 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Mischief {
    /// The frame with the n-th answer is lost on its way back.
    LoseAnswer(u32),
    /// The frame that would fetch the n-th answer is lost on its way out.
    LoseFetch(u32),
    /// The frame with the n-th request is lost on its way back: the request has arrived.
    LoseRequestEcho(u32),
    /// As `LoseAnswer` and `LoseRequestEcho`, but the wire itself retries and returns the second
    /// working counter.
    FetchTwice(u32),
    RequestTwice(u32),
    /// The frame with the n-th request never arrives.
    LoseRequest(u32),
    /// Sends these bytes instead of the n-th answer.
    Replace(u32, Vec<u8>),
    /// Sends these bytes before the n-th answer.
    Before(u32, Vec<u8>),
    /// Changes one byte of the n-th answer.
    Corrupt(u32, usize, u8),
    /// Skips the n-th answer.
    Skip(u32),
    /// Never acknowledges a repeat request.
    NoRepeat,
    /// Does not read its mailbox.
    Deaf,
    /// Reads its mailbox only while its other mailbox is empty.
    Blocked,
    /// Accepts requests and never answers.
    Mute,
    /// Processes no datagram.
    Off,
    /// Answers segments with the wrong toggle bit.
    WrongToggle,
    /// Announces this size in normal uploads, regardless of the data.
    AnnounceSize(u32),
    /// Accepts writes but keeps the old value.
    Forgetful,
    /// Does not allow reading this object.
    WriteOnly(u16),
    /// Aborts complete access with this code.
    NoCompleteAccess(u32),
    /// Every segment is empty, and no segment is the last.
    EmptySegments,
}

pub fn emergency(code: u16) -> Vec<u8> {
    let [low, high] = code.to_le_bytes();
    vec![
        10, 0, 0, 0, 0, 0x13, 0, 0x10, low, high, 0x21, 1, 2, 3, 4, 5,
    ]
}
