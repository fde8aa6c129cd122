//! CDR as ROS 2 uses it: OMG XCDR1, little-endian, with the encapsulation header.

/// The encapsulation header `CDR_LE` (DDSI-RTPS, "Data encapsulation").
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Appends one message to a buffer.
#[derive(Debug)]
pub struct CdrEncoder<'b> {
    bytes: &'b mut Vec<u8>,
    /// The place after the header, from which alignment counts.
    origin: usize,
}

impl<'b> CdrEncoder<'b> {
    /// Begins a message at the end of `bytes`.
    pub fn new(bytes: &'b mut Vec<u8>) -> Self {
        bytes.extend(HEADER);
        let origin = bytes.len();
        Self { bytes, origin }
    }

    /// Appends a primitive value, aligned to its size.
    fn primitive<const N: usize>(&mut self, value: [u8; N]) {
        let length = (self.bytes.len() - self.origin).next_multiple_of(N);
        self.bytes.resize(self.origin + length, 0);
        self.bytes.extend(value);
    }

    pub fn bool(&mut self, value: bool) {
        self.u8(u8::from(value));
    }

    pub fn u8(&mut self, value: u8) {
        self.primitive([value]);
    }

    pub fn i8(&mut self, value: i8) {
        self.primitive(value.to_le_bytes());
    }

    pub fn u16(&mut self, value: u16) {
        self.primitive(value.to_le_bytes());
    }

    pub fn u32(&mut self, value: u32) {
        self.primitive(value.to_le_bytes());
    }

    pub fn i32(&mut self, value: i32) {
        self.primitive(value.to_le_bytes());
    }

    pub fn u64(&mut self, value: u64) {
        self.primitive(value.to_le_bytes());
    }

    pub fn f64(&mut self, value: f64) {
        self.primitive(value.to_le_bytes());
    }

    /// Appends a string up to its first NUL, which CDR cannot contain.
    pub fn string(&mut self, text: &str) {
        let text = text.split('\0').next().unwrap_or_default();
        self.length(text.len() + 1);
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
    }

    /// Appends the number of elements of a sequence, which follow.
    pub fn length(&mut self, count: usize) {
        // Each of 2^32 elements would be in memory.
        self.u32(u32::try_from(count).unwrap_or(u32::MAX));
    }
}
