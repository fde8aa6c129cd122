//! Texts of mailbox error codes (ETG.1000.4).

/// Returns the text of the code in a mailbox error reply.
#[must_use]
pub fn mailbox_error_text(code: u16) -> &'static str {
    match code {
        0x0001 => "the mailbox header is wrong",
        0x0002 => "the mailbox protocol is not supported",
        0x0003 => "the channel field is wrong",
        0x0004 => "the service is not supported",
        0x0005 => "the protocol header is wrong",
        0x0006 => "the message is too short",
        0x0007 => "out of memory",
        0x0008 => "the lengths contradict each other",
        _ => "unknown mailbox error code",
    }
}
