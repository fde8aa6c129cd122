//! What a SubDevice, or the way to it, can do wrong.

/// What goes wrong, and when. Numbers count mailbox messages (or accesses) from 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Mischief {
    /// The frame with the n-th answer is lost on its way back.
    LoseAnswer(u32),
    /// The frame that would fetch the n-th answer is lost on its way there.
    LoseFetch(u32),
    /// The frame with the n-th request is lost on its way back: the request has arrived.
    LoseRequestEcho(u32),
    /// As `LoseAnswer` and `LoseRequestEcho`, but the wire itself tries again and tells the second working counter.
    FetchTwice(u32),
    RequestTwice(u32),
    /// The frame with the n-th request never arrives.
    LoseRequest(u32),
    /// Sends these bytes in place of the n-th answer.
    Replace(u32, Vec<u8>),
    /// Sends these bytes before the n-th answer.
    Before(u32, Vec<u8>),
    /// Changes one byte of the n-th answer.
    Corrupt(u32, usize, u8),
    /// Leaves the n-th answer out.
    Skip(u32),
    /// Never acknowledges a repeat request.
    NoRepeat,
    /// Does not look at its mailbox.
    Deaf,
    /// Looks at it only while its other mailbox is empty.
    Blocked,
    /// Takes requests and says nothing.
    Mute,
    /// Takes part in no datagram.
    Off,
    /// Answers segments with the wrong toggle bit.
    WrongToggle,
    /// Announces this size in normal uploads, whatever it sends.
    AnnounceSize(u32),
    /// Takes what is written and keeps what it had.
    Forgetful,
    /// Does not let this object be read.
    WriteOnly(u16),
    /// Every segment but the last is empty, and there is no last.
    EmptySegments,
}

pub fn emergency(code: u16) -> Vec<u8> {
    let [low, high] = code.to_le_bytes();
    vec![
        10, 0, 0, 0, 0, 0x13, 0, 0x10, low, high, 0x21, 1, 2, 3, 4, 5,
    ]
}
