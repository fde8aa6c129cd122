//! The IDNs of a simulated Sercos drive: attributes, limits and values.

use std::collections::BTreeMap;

/// Lengths of values (attribute bits 16 to 18).
mod length {
    pub(super) const WORD: u32 = 1 << 16;
    pub(super) const LONG: u32 = 2 << 16;
    pub(super) const QUAD: u32 = 3 << 16;
    pub(super) const BYTES: u32 = 4 << 16;
    pub(super) const WORDS: u32 = 5 << 16;
    pub(super) const LONGS: u32 = 6 << 16;
}

/// Types and displays (attribute bits 20 to 22).
mod display {
    pub(super) const BINARY: u32 = 0;
    pub(super) const UNSIGNED: u32 = 1 << 20;
    pub(super) const SIGNED: u32 = 2 << 20;
    pub(super) const HEX: u32 = 3 << 20;
    pub(super) const TEXT: u32 = 4 << 20;
    pub(super) const IDN: u32 = 5 << 20;
}

const COMMAND: u32 = 1 << 19;
/// Write-protected in PreOp, SafeOp, Op.
const IN_PRE_OP: u32 = 1 << 28;
const IN_SAFE_OP: u32 = 1 << 29;
const IN_OP: u32 = 1 << 30;
const READ_ONLY: u32 = IN_PRE_OP | IN_SAFE_OP | IN_OP;
/// Writable in PreOp only: the configuration of the communication.
const CONFIGURATION: u32 = IN_SAFE_OP | IN_OP;

/// The elements of an IDN.
#[derive(Debug, Clone)]
pub(super) struct Idn {
    pub name: &'static str,
    pub attribute: u32,
    pub unit: &'static str,
    /// Smallest and largest value.
    pub range: Option<(i64, i64)>,
    /// Lists have no lengths here.
    pub value: Vec<u8>,
    pub default: Vec<u8>,
    /// The longest list in bytes.
    pub max: usize,
    /// True if a password protects it.
    pub locked: bool,
}

impl Idn {
    /// Returns the bytes of one value or one list element.
    pub fn width(&self) -> usize {
        match self.attribute >> 16 & 7 {
            1 | 5 => 2,
            2 | 6 => 4,
            4 => 1,
            _ => 8,
        }
    }

    pub fn is_list(&self) -> bool {
        self.attribute >> 16 & 7 >= 4
    }

    pub fn is_command(&self) -> bool {
        self.attribute & COMMAND != 0
    }

    pub fn is_signed(&self) -> bool {
        self.attribute >> 20 & 7 == 2
    }
}

/// The IDNs of a drive by number.
pub(super) type Dictionary = BTreeMap<u16, Idn>;

/// The longest list of the drive: 1,024 elements of four bytes.
pub(super) const LONG_LIST: usize = 4096;
/// Product-specific IDNs.
pub(super) const P: u16 = 0x8000;

/// Returns the dictionary of a drive as delivered.
pub(super) fn new(counts_per_turn: u32) -> Dictionary {
    let mut all = Dictionary::new();
    let mut add = |idn: u16, name, attribute, unit, range, value: &[u8], max| {
        let new = Idn {
            name,
            attribute: attribute | 1,
            unit,
            range,
            value: value.to_vec(),
            default: value.to_vec(),
            max,
            locked: false,
        };
        all.insert(idn, new);
    };
    use display::{BINARY, HEX, IDN, SIGNED, TEXT, UNSIGNED};
    use length::{BYTES, LONG, LONGS, QUAD, WORD, WORDS};
    let word = |value: u16| value.to_le_bytes();
    let three = 3 << 24;
    let cycle = Some((250, 65_535));
    add(
        1,
        "NC cycle time (TNcyc)",
        WORD | UNSIGNED | CONFIGURATION,
        "us",
        cycle,
        &word(2000),
        0,
    );
    add(
        2,
        "Communication cycle time (TScyc)",
        WORD | UNSIGNED | CONFIGURATION,
        "us",
        cycle,
        &word(2000),
        0,
    );
    add(
        11,
        "Class 1 diagnostic",
        WORD | BINARY | READ_ONLY,
        "",
        None,
        &word(0),
        0,
    );
    add(
        12,
        "Class 2 diagnostic",
        WORD | BINARY | READ_ONLY,
        "",
        None,
        &word(0),
        0,
    );
    add(
        15,
        "Telegram type",
        WORD | BINARY | CONFIGURATION,
        "",
        Some((7, 7)),
        &word(7),
        0,
    );
    add(
        16,
        "Configuration list of AT",
        WORDS | IDN | CONFIGURATION,
        "",
        None,
        &[],
        24,
    );
    add(
        17,
        "IDN list of all operation data",
        WORDS | IDN | READ_ONLY,
        "",
        None,
        &[],
        LONG_LIST,
    );
    add(
        24,
        "Configuration list of MDT",
        WORDS | IDN | CONFIGURATION,
        "",
        None,
        &[],
        24,
    );
    add(
        25,
        "IDN list of all procedure commands",
        WORDS | IDN | READ_ONLY,
        "",
        None,
        &word(99),
        2,
    );
    add(
        30,
        "Manufacturer version",
        BYTES | TEXT | READ_ONLY,
        "",
        None,
        b"sim 1.0",
        40,
    );
    add(
        32,
        "Primary operation mode",
        WORD | BINARY | IN_OP,
        "",
        None,
        &word(0x000b),
        0,
    );
    add(
        36,
        "Velocity command value",
        LONG | SIGNED | three,
        "rpm",
        None,
        &[0; 4],
        0,
    );
    add(
        40,
        "Velocity feedback value 1",
        LONG | SIGNED | READ_ONLY | three,
        "rpm",
        None,
        &[0; 4],
        0,
    );
    add(
        44,
        "Velocity data scaling type",
        WORD | BINARY | READ_ONLY,
        "",
        None,
        &word(2),
        0,
    );
    add(
        45,
        "Velocity data scaling factor",
        WORD | UNSIGNED | READ_ONLY,
        "",
        None,
        &word(1),
        0,
    );
    add(
        46,
        "Velocity data scaling exponent",
        WORD | SIGNED | READ_ONLY,
        "",
        None,
        &(-3_i16).to_le_bytes(),
        0,
    );
    add(
        47,
        "Position command value",
        LONG | SIGNED,
        "inc",
        None,
        &[0; 4],
        0,
    );
    add(
        51,
        "Position feedback value 1",
        LONG | SIGNED | READ_ONLY,
        "inc",
        None,
        &[0; 4],
        0,
    );
    add(
        76,
        "Position data scaling type",
        WORD | BINARY | READ_ONLY,
        "",
        None,
        &word(2),
        0,
    );
    add(
        79,
        "Rotational position resolution",
        LONG | UNSIGNED | READ_ONLY,
        "inc",
        None,
        &counts_per_turn.to_le_bytes(),
        0,
    );
    add(
        80,
        "Torque command value",
        WORD | SIGNED | 1 << 24,
        "%",
        None,
        &word(0),
        0,
    );
    add(
        84,
        "Torque feedback value",
        WORD | SIGNED | READ_ONLY | 1 << 24,
        "%",
        None,
        &word(0),
        0,
    );
    add(
        91,
        "Bipolar velocity limit value",
        LONG | UNSIGNED | three,
        "rpm",
        Some((0, 10_000_000)),
        &6_000_000_u32.to_le_bytes(),
        0,
    );
    add(
        95,
        "Diagnostic message",
        BYTES | TEXT | READ_ONLY,
        "",
        None,
        b"ready",
        80,
    );
    add(
        99,
        "Reset class 1 diagnostic",
        WORD | BINARY | COMMAND,
        "",
        None,
        &word(0),
        0,
    );
    add(
        134,
        "Master control word",
        WORD | BINARY,
        "",
        None,
        &word(0),
        0,
    );
    add(
        135,
        "Drive status word",
        WORD | BINARY | READ_ONLY,
        "",
        None,
        &word(0),
        0,
    );
    add(
        138,
        "Bipolar acceleration limit value",
        LONG | UNSIGNED | three,
        "rad/s^2",
        Some((1, 50_000_000)),
        &1_000_000_u32.to_le_bytes(),
        0,
    );
    add(
        189,
        "Following distance",
        LONG | SIGNED | READ_ONLY,
        "inc",
        None,
        &[0; 4],
        0,
    );
    add(
        390,
        "Diagnostic number",
        LONG | HEX | READ_ONLY,
        "",
        None,
        &[0; 4],
        0,
    );
    add(
        P | 10,
        "Feature flags",
        QUAD | HEX | IN_SAFE_OP | IN_OP,
        "",
        None,
        &[0; 8],
        0,
    );
    add(
        P | 100,
        "Table",
        LONGS | SIGNED,
        "inc",
        None,
        &[],
        LONG_LIST,
    );
    add(P | 101, "Axis name", BYTES | TEXT, "", None, b"axis", 64);
    add(
        P | 102,
        "Service parameter",
        WORD | UNSIGNED,
        "",
        None,
        &word(1),
        0,
    );
    if let Some(locked) = all.get_mut(&(P | 102)) {
        locked.locked = true;
    }
    let list: Vec<u8> = all.keys().flat_map(|idn| idn.to_le_bytes()).collect();
    if let Some(idns) = all.get_mut(&17) {
        idns.value = list;
    }
    all
}
