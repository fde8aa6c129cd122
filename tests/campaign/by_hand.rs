//! Recordings assembled byte by byte: one drive behind a first device, in one LRW.

/// The cycle in ns.
pub const CYCLE: u64 = 1_000_000;
pub const OUTPUTS: [u16; 5] = [0x6040, 0x6060, 0x607a, 0x60ff, 0x6071];
pub const INPUTS: [u16; 3] = [0x6041, 0x6061, 0x6064];
const STATION: u16 = 0x1001;
const LOGICAL: u32 = 0x0001_0000;
/// Inputs and outputs share this length; the outputs are the longer ones.
const BYTES: usize = 13;

/// One cycle of one drive: its outputs and its answer. `None`: the frame is lost.
#[derive(Debug, Clone, Copy)]
pub struct Row {
    pub controlword: u16,
    pub mode: i8,
    pub position: i32,
    pub velocity: i32,
    pub torque: i16,
    pub answer: Option<(u16, i8, i32)>,
    /// The time from the frame to its reply, in ns.
    pub back: u64,
    /// Another device on the bus does not answer.
    pub incomplete: bool,
}

fn frame(source: u8, datagrams: &[(u8, u8, u32, Vec<u8>, u16)]) -> Vec<u8> {
    let mut body = Vec::new();
    for (number, (command, index, address, data, counter)) in datagrams.iter().enumerate() {
        let more = if number + 1 < datagrams.len() {
            0x8000
        } else {
            0
        };
        body.extend([*command, *index]);
        body.extend(address.to_le_bytes());
        body.extend((data.len() as u16 | more).to_le_bytes());
        body.extend([0, 0]);
        body.extend(data);
        body.extend(counter.to_le_bytes());
    }
    let mut frame = vec![0xff; 6];
    frame.extend([0x10, 0x10, 0x10, 0x10, 0x10, source, 0x88, 0xa4]);
    frame.extend((body.len() as u16 | 0x1000).to_le_bytes());
    frame.extend(body);
    frame
}

/// An Enhanced Packet Block.
fn block(at: u64, sent: bool, frame: &[u8]) -> Vec<u8> {
    let mut block = Vec::new();
    block.extend(0u32.to_le_bytes());
    block.extend(((at >> 32) as u32).to_le_bytes());
    block.extend((at as u32).to_le_bytes());
    block.extend((frame.len() as u32).to_le_bytes());
    block.extend((frame.len() as u32).to_le_bytes());
    block.extend(frame);
    block.resize(block.len().next_multiple_of(4), 0);
    block.extend([2, 0, 4, 0, if sent { 2 } else { 1 }, 0, 0, 0, 0, 0, 0, 0]);
    let length = block.len() as u32 + 12;
    let mut whole = 6u32.to_le_bytes().to_vec();
    whole.extend(length.to_le_bytes());
    whole.extend(block);
    whole.extend(length.to_le_bytes());
    whole
}

fn fmmu(physical: u16, bytes: u16, direction: u8) -> Vec<u8> {
    let mut fmmu = LOGICAL.to_le_bytes().to_vec();
    fmmu.extend(bytes.to_le_bytes());
    fmmu.extend([0, 7]);
    fmmu.extend(physical.to_le_bytes());
    fmmu.extend([0, direction, 1, 0, 0, 0]);
    fmmu
}

fn register(station: u16, register: u16) -> u32 {
    u32::from(station) | u32::from(register) << 16
}

/// Returns the recording of these rows, with AL control writes at the end of some cycles.
pub fn recording(rows: &[Row], al_control: &[(usize, u8)]) -> Vec<u8> {
    let mut file = Vec::new();
    // Section header and interface; the reader ignores their contents.
    file.extend([0x0a, 0x0d, 0x0d, 0x0a, 12, 0, 0, 0, 12, 0, 0, 0]);
    file.extend([1, 0, 0, 0, 12, 0, 0, 0, 12, 0, 0, 0]);
    let minus_one = u32::from(1u16.wrapping_neg()) | 0x0010 << 16;
    let address = (2, 0, minus_one, STATION.to_le_bytes().to_vec(), 0);
    file.extend(block(0, true, &frame(0x10, &[address])));
    let outputs = (
        5,
        1,
        register(STATION, 0x0600),
        fmmu(0x1100, BYTES as u16, 2),
        0,
    );
    let inputs = (5, 2, register(STATION, 0x0610), fmmu(0x1400, 7, 1), 0);
    file.extend(block(10, true, &frame(0x10, &[outputs])));
    file.extend(block(20, true, &frame(0x10, &[inputs])));
    let mut late: Vec<(u64, Vec<u8>)> = Vec::new();
    for (number, row) in rows.iter().enumerate() {
        let at = CYCLE * (number as u64 + 1);
        late.retain(|(back, frame)| {
            if *back < at {
                file.extend(block(*back, false, frame));
            }
            *back >= at
        });
        let mut data = row.controlword.to_le_bytes().to_vec();
        data.push(row.mode as u8);
        data.extend(row.position.to_le_bytes());
        data.extend(row.velocity.to_le_bytes());
        data.extend(row.torque.to_le_bytes());
        let sent = frame(0x20, &[(12, number as u8, LOGICAL, data.clone(), 0)]);
        file.extend(block(at, true, &sent));
        if let Some((statusword, mode, position)) = row.answer {
            data[..2].copy_from_slice(&statusword.to_le_bytes());
            data[2] = mode as u8;
            data[3..7].copy_from_slice(&position.to_le_bytes());
            let counter = if row.incomplete { 2 } else { 3 };
            let reply = frame(0x20, &[(12, number as u8, LOGICAL, data, counter)]);
            late.push((at + row.back, reply));
        }
        for (_, state) in al_control.iter().filter(|of| of.0 == number) {
            let write = (5, 9, register(STATION, 0x0120), vec![*state, 0], 0);
            file.extend(block(at + CYCLE / 2, true, &frame(0x10, &[write])));
        }
    }
    for (back, frame) in late {
        file.extend(block(back, false, &frame));
    }
    file
}
