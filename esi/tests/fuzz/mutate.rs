//! Seeded changes to XML: bytes, numbers, whole elements, and pieces of other files.

/// splitmix64 random numbers.
pub struct Dice(pub u64);

impl Dice {
    pub fn roll(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Returns a number from 0 to `end` − 1, or 0 if `end` is 0.
    pub fn below(&mut self, end: usize) -> usize {
        (self.roll() % end.max(1) as u64) as usize
    }

    pub fn pick<'t, T>(&mut self, from: &'t [T]) -> &'t T {
        &from[self.below(from.len())]
    }
}

const NUMBERS: &[&str] = &[
    "0",
    "1",
    "2",
    "7",
    "8",
    "16",
    "254",
    "255",
    "256",
    "65535",
    "65536",
    "4294967295",
    "4294967296",
    "-1",
    "#x0",
    "#xffff",
    "#x1600",
    "#x1a00",
    "#x6040",
    "#x10000",
    "0x1c12",
    "#x",
    "-32769",
    "99999999999999999999",
    "1e3",
    " 3 ",
    "",
];

const PARTS: &[&str] = &[
    "<Entry><Index>#x6041</Index><BitLen>16</BitLen></Entry>",
    "<Entry><Index>0</Index><BitLen>7</BitLen></Entry>",
    "<Exclude>#x1600</Exclude>",
    "<ExcludedSm>2</ExcludedSm>",
    "<Sm StartAddress=\"#x1400\" ControlByte=\"#x20\">Inputs</Sm>",
    "<Sm No=\"3\"><Pdo OSFac=\"3\">#x1a00</Pdo></Sm>",
    "<TxPdo Sm=\"3\"><Index>#x1a02</Index></TxPdo>",
    "<Mailbox><CoE PdoAssign=\"1\" PdoConfig=\"1\"/></Mailbox>",
    "<Slots><Slot MaxInstances=\"300\"><ModuleIdent>1</ModuleIdent></Slot></Slots>",
    "<Fmmu>Inputs</Fmmu>",
    "<Mandatory/>",
    " Sm=\"2\"",
    " Fixed=\"1\"",
    " Virtual=\"1\"",
    " Mandatory=\"1\"",
    " DependOnSlot=\"1\"",
    " OSFac=\"9\" OSIndexInc=\"1\"",
    " MinInstances=\"3\"",
    "<!-- -->",
    "<![CDATA[",
    "&a;",
    "&#0;",
    "\0",
];

/// Applies one to four changes.
pub fn mutate(original: &[u8], others: &[Vec<u8>], dice: &mut Dice) -> Vec<u8> {
    let mut bytes = original.to_vec();
    for _ in 0..=dice.below(4) {
        change(&mut bytes, others, dice);
    }
    bytes.truncate(64 << 10);
    bytes
}

fn change(bytes: &mut Vec<u8>, others: &[Vec<u8>], dice: &mut Dice) {
    match dice.below(24) {
        0 => {
            let at = dice.below(bytes.len());
            if let Some(byte) = bytes.get_mut(at) {
                *byte = dice.roll().to_le_bytes()[0];
            }
        }
        1..=8 => number(bytes, dice),
        9..=11 => {
            let element = element(bytes, dice);
            bytes.drain(element);
        }
        12..=14 => {
            let element = element(bytes, dice);
            let copy = bytes[element.clone()].repeat(1 + dice.below(3));
            bytes.splice(element.start..element.start, copy);
        }
        15..=19 => {
            let part = dice.pick(PARTS);
            let at = boundary(bytes, part.starts_with(' '), dice);
            bytes.splice(at..at, part.bytes());
        }
        20..=22 => {
            let other = dice.pick(others);
            let piece = other[element(other, dice)].to_vec();
            let at = boundary(bytes, false, dice);
            bytes.splice(at..at, piece);
        }
        _ => {
            let end = dice.below(bytes.len());
            bytes.truncate(end);
        }
    }
}

/// Replaces a number.
fn number(bytes: &mut Vec<u8>, dice: &mut Dice) {
    let digit = |byte: &u8| byte.is_ascii_digit();
    let from = dice.below(bytes.len());
    let Some(start) = bytes[from..].iter().position(digit).map(|at| from + at) else {
        return;
    };
    let rest = bytes[start..].iter();
    let end = start + rest.take_while(|byte| byte.is_ascii_hexdigit()).count();
    let start = match start.checked_sub(2).and_then(|at| bytes.get(at..start)) {
        Some(b"#x") => start - 2,
        _ => start,
    };
    bytes.splice(start..end, dice.pick(NUMBERS).bytes());
}

/// Returns the start of a start tag or, for an attribute, the end of the tag's name.
fn boundary(bytes: &[u8], attribute: bool, dice: &mut Dice) -> usize {
    let from = dice.below(bytes.len());
    let starts = |pair: &[u8]| pair[0] == b'<' && pair[1].is_ascii_alphabetic();
    let after = bytes[from..].windows(2).position(starts);
    let at = after.map_or(from, |at| from + at);
    if !attribute {
        return at;
    }
    let rest = bytes[at..].iter().skip(1);
    let name = rest.take_while(|byte| byte.is_ascii_alphanumeric()).count();
    (at + 1 + name).min(bytes.len())
}

/// Returns the range from a `<` to the end of the element of that name, or of the tag.
fn element(bytes: &[u8], dice: &mut Dice) -> std::ops::Range<usize> {
    let start = boundary(bytes, false, dice);
    let rest = &bytes[start..];
    let name: Vec<u8> = rest
        .iter()
        .skip(1)
        .take_while(|byte| byte.is_ascii_alphanumeric())
        .copied()
        .collect();
    let close = [b"</".as_slice(), &name, b">"].concat();
    let end = rest
        .windows(close.len())
        .position(|window| window == close)
        .map(|at| at + close.len())
        .or_else(|| rest.iter().position(|byte| *byte == b'>').map(|at| at + 1));
    start..start + end.unwrap_or(rest.len())
}
