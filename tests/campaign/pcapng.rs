//! Reads a recording: pcapng after IETF draft-ietf-opsawg-pcapng, sections 3.1 (blocks) and 4.3
//! (Enhanced Packet Block) with its option `epb_flags`.

const ENHANCED_PACKET: u32 = 6;
const EPB_FLAGS: u16 = 2;
const OUTBOUND: u32 = 2;

/// A frame with its direction and its time in ns. `ecaxis` writes ns (`if_tsresol` 9).
#[derive(Debug, Clone, Copy)]
pub struct Packet<'a> {
    pub at: u64,
    pub sent: bool,
    pub frame: &'a [u8],
}

fn u16_at(data: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(data.get(at..at + 2)?.try_into().ok()?))
}

fn u32_at(data: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(data.get(at..at + 4)?.try_into().ok()?))
}

/// Returns every packet of the recording; fails if a block does not fit.
pub fn packets(file: &[u8]) -> Result<Vec<Packet<'_>>, String> {
    let mut packets = Vec::new();
    let mut at = 0;
    while at < file.len() {
        let damaged = || format!("damaged block at byte {at}");
        let length = u32_at(file, at + 4).ok_or_else(damaged)? as usize;
        let block = file.get(at..at + length).filter(|_| length >= 12);
        let block = block.ok_or_else(damaged)?;
        if u32_at(block, 0) == Some(ENHANCED_PACKET) {
            packets.push(packet(block).ok_or_else(damaged)?);
        }
        at += length;
    }
    Ok(packets)
}

fn packet(block: &[u8]) -> Option<Packet<'_>> {
    let at = u64::from(u32_at(block, 12)?) << 32 | u64::from(u32_at(block, 16)?);
    let captured = u32_at(block, 20)? as usize;
    let frame = block.get(28..28 + captured)?;
    let mut option = 28 + captured.next_multiple_of(4);
    let mut sent = false;
    while let (Some(code), Some(length)) = (u16_at(block, option), u16_at(block, option + 2)) {
        match code {
            0 => break,
            EPB_FLAGS => sent = u32_at(block, option + 4)? & 3 == OUTBOUND,
            _ => {}
        }
        option += 4 + usize::from(length).next_multiple_of(4);
        if option + 4 > block.len() - 4 {
            break;
        }
    }
    Some(Packet { at, sent, frame })
}
