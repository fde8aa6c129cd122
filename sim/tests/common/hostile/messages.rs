//! Mailbox messages: CoE and FoE as a MainDevice sends them, partly invalid.

use super::Dice;

/// Returns a mailbox of this size with a message whose lengths may be wrong.
pub fn message(dice: &mut Dice, size: usize) -> Vec<u8> {
    let kind = dice.pick(&[3, 3, 3, 3, 3, 3, 4, 4, 0, 1, 2, 5, 15, 9]);
    let mut body = match kind {
        3 => coe(dice),
        4 => foe(dice),
        _ => {
            let len = dice.below(40);
            dice.bytes(len)
        }
    };
    if dice.percent(5) {
        let len = dice.below(size + 1);
        body.resize(len, 0x5a);
    }
    let length = match dice.below(20) {
        0 => dice.roll() as u16,
        1 => dice.below(size + 10) as u16,
        _ => body.len() as u16,
    };
    let mut message = length.to_le_bytes().to_vec();
    message.extend_from_slice(&[0, 0, dice.roll() as u8 & 3]);
    message.push(kind | (dice.below(8) as u8) << 4);
    message.extend_from_slice(&body);
    // Access to the last byte completes the mailbox.
    message.resize(size, 0);
    message
}

fn coe(dice: &mut Dice) -> Vec<u8> {
    let service = dice.pick(&[2, 2, 2, 2, 2, 2, 8, 8, 1, 3, 4, 7, 0, 15]);
    let mut body = vec![
        dice.pick(&[0, 0, 0, 1, 0xff]),
        service << 4 | dice.roll() as u8 & 1,
    ];
    let index: u16 = match dice.below(10) {
        0 => dice.roll() as u16,
        _ => dice.pick(&[
            0x1000, 0x1001, 0x1008, 0x1010, 0x1011, 0x1018, 0x10f3, 0x1600, 0x1a00, 0x1c00, 0x1c12,
            0x1c13, 0x1c32, 0x2000, 0x2001, 0x2002, 0x2003, 0x2010, 0x2011, 0x2020, 0x2021, 0x2024,
            0x2026, 0x30a0, 0x30a1, 0x3000, 0x6040, 0x6041, 0x6060, 0x6065, 0x607a, 0x607d, 0x60c2,
            0x6098, 0x60b8, 0x60a8, 0x605a, 0x7000, 0xf030, 0xf000,
        ]),
    };
    if service == 8 {
        let opcode = dice.pick(&[1, 1, 3, 3, 5, 5, 0, 2, 4, 6, 7, 0x7f]);
        body.extend_from_slice(&[opcode | dice.roll() as u8 & 0x80, 0, 0, 0]);
        let what = if opcode == 1 {
            dice.below(8) as u16
        } else {
            index
        };
        body.extend_from_slice(&what.to_le_bytes());
        body.extend_from_slice(&[dice.below(10) as u8, dice.roll() as u8]);
        return body;
    }
    let command = match dice.below(10) {
        0 => dice.roll() as u8,
        _ => dice.pick(&[
            0x40, 0x40, 0x40, 0x50, 0x60, 0x70, 0x21, 0x20, 0x23, 0x27, 0x2b, 0x2f, 0x30, 0x31,
            0x33, 0x00, 0x01, 0x10, 0x11, 0x0d, 0x80,
        ]),
    };
    body.push(command);
    if command >> 5 == 0 {
        let len = dice.below(45);
        body.extend_from_slice(&dice.bytes(len));
        return body;
    }
    body.extend_from_slice(&index.to_le_bytes());
    body.push(match dice.below(8) {
        0 => dice.roll() as u8,
        n => n as u8 - 1,
    });
    let size: u32 = match dice.below(6) {
        0 => dice.roll() as u32,
        1 => dice.pick(&[0, 1, 0xff, 0xffff, 0x7fff_ffff, 0xffff_ffff]),
        2 => 64,
        _ => dice.below(9) as u32,
    };
    body.extend_from_slice(&size.to_le_bytes());
    if command & 0xe2 == 0x20 {
        let len = dice.below(40);
        body.extend_from_slice(&dice.bytes(len));
    }
    body
}

fn foe(dice: &mut Dice) -> Vec<u8> {
    let opcode = match dice.below(10) {
        0 => dice.roll() as u8,
        _ => dice.pick(&[1, 2, 3, 3, 3, 4, 4, 5, 6]),
    };
    let mut body = vec![opcode, dice.roll() as u8];
    let number: u32 = match dice.below(4) {
        0 => dice.roll() as u32,
        _ => dice.below(6) as u32,
    };
    body.extend_from_slice(&number.to_le_bytes());
    match opcode {
        1 | 2 => {
            let len = dice.below(20);
            let name = dice.pick(&[&b"app.bin"[..], b"", b"\xff\xfe\0", b"../../etc/passwd"]);
            body.extend_from_slice(name);
            body.extend_from_slice(&dice.bytes(if len > 15 { len } else { 0 }));
        }
        _ => {
            let len = dice.below(37);
            body.extend_from_slice(&dice.bytes(len));
        }
    }
    body
}
