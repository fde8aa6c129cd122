//! The process image: logical addresses, datagrams and frames ([`mod@plan`]), and the bits of
//! objects.

use ecaxis_esi::address;
use ecaxis_esi::layout::{Field, Layout};

mod copy;
pub mod plan;

pub use copy::BitCopy;
pub use plan::{
    Access, DatagramPlan, DeviceRegion, ImagePlan, MailboxPlan, OpOnly, ProcessData, TooLarge, of,
    plan,
};

/// The bits of one object in the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BitField {
    byte: usize,
    shift: u8,
    len: u8,
}

impl BitField {
    /// Returns `None` if the field is longer than 64 bits or lies outside the region.
    #[must_use]
    pub fn new(field: &Field, offset: usize, region_len: usize) -> Option<Self> {
        let bit = usize::try_from(field.bit_offset).ok()?;
        let len = u8::try_from(field.bit_len)
            .ok()
            .filter(|len| (1..=64).contains(len))?;
        let end = (bit + usize::from(len)).div_ceil(8);
        (end <= region_len).then(|| Self {
            byte: offset + bit / 8,
            shift: u8::try_from(bit % 8).unwrap_or(0),
            len,
        })
    }

    /// Returns the field at a bit of the image; `len` is 1 to 64.
    fn at(bit: usize, len: usize) -> Self {
        debug_assert!((1..=64).contains(&len));
        Self {
            byte: bit / 8,
            shift: (bit % 8) as u8,
            len: len as u8,
        }
    }

    /// Returns the bits as a sign-extended number. RT.
    #[must_use]
    pub fn get(self, image: &[u8]) -> i64 {
        // Fast path for whole objects of common lengths.
        let at = image.get(self.byte..).unwrap_or_default();
        match (self.shift, self.len) {
            (0, 8) => return at.first_chunk().map_or(0, |b| i8::from_le_bytes(*b).into()),
            (0, 16) => {
                return at
                    .first_chunk()
                    .map_or(0, |b| i16::from_le_bytes(*b).into());
            }
            (0, 32) => {
                return at
                    .first_chunk()
                    .map_or(0, |b| i32::from_le_bytes(*b).into());
            }
            _ => {}
        }
        let end = self.byte + (usize::from(self.shift) + usize::from(self.len)).div_ceil(8);
        let mut raw = 0_u128;
        for (i, &byte) in image.get(self.byte..end).unwrap_or(&[]).iter().enumerate() {
            raw |= u128::from(byte) << (8 * i);
        }
        let value = (raw >> self.shift) as u64;
        let unused = 64 - u32::from(self.len);
        ((value << unused) as i64) >> unused
    }

    /// Replaces the bits and leaves their neighbours unchanged. RT.
    pub fn set(self, image: &mut [u8], value: i64) {
        if self.shift == 0 && matches!(self.len, 8 | 16 | 32) {
            let len = usize::from(self.len / 8);
            let to = image.get_mut(self.byte..self.byte + len);
            if let (Some(to), Some(from)) = (to, value.to_le_bytes().get(..len)) {
                to.copy_from_slice(from);
            }
            return;
        }
        let end = self.byte + (usize::from(self.shift) + usize::from(self.len)).div_ceil(8);
        let mask = (u128::from(u64::MAX >> (64 - u32::from(self.len)))) << self.shift;
        let bits = (u128::from(value as u64) << self.shift) & mask;
        for (i, byte) in image
            .get_mut(self.byte..end)
            .unwrap_or(&mut [])
            .iter_mut()
            .enumerate()
        {
            let keep = !((mask >> (8 * i)) as u8);
            *byte = (*byte & keep) | ((bits >> (8 * i)) as u8);
        }
    }
}

/// The number format of a signal's bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NumericFormat {
    Unsigned,
    Signed,
    /// IEEE 754, 32 bits.
    Real,
}

/// Bits that the program reads or sets as a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SignalBits {
    pub bits: BitField,
    pub kind: NumericFormat,
}

impl SignalBits {
    /// Returns the value. RT.
    #[must_use]
    pub fn get(self, image: &[u8]) -> f64 {
        let raw = self.bits.get(image);
        match self.kind {
            NumericFormat::Signed => raw as f64,
            NumericFormat::Unsigned => {
                (raw as u64 & (u64::MAX >> (64 - u32::from(self.bits.len)))) as f64
            }
            NumericFormat::Real => f64::from(f32::from_bits(raw as u32)),
        }
    }

    /// Sets the value, clamped to the range of the bits. RT.
    pub fn set(self, image: &mut [u8], value: f64) {
        let raw = match self.kind {
            NumericFormat::Signed => value as i64,
            NumericFormat::Unsigned => value as u64 as i64,
            NumericFormat::Real => i64::from((value as f32).to_bits()),
        };
        self.bits.set(image, raw);
    }
}

/// The objects of a cyclic synchronous axis in the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AxisBits {
    pub controlword: BitField,
    pub statusword: BitField,
    pub mode: Option<BitField>,
    pub mode_display: Option<BitField>,
    pub target_position: Option<BitField>,
    pub target_velocity: Option<BitField>,
    pub target_torque: Option<BitField>,
    pub velocity_offset: Option<BitField>,
    pub torque_offset: Option<BitField>,
    pub error_code: Option<BitField>,
    pub profile_velocity: Option<BitField>,
    pub profile_acceleration: Option<BitField>,
    pub profile_deceleration: Option<BitField>,
    pub touch_probe_function: Option<BitField>,
    pub touch_probe_status: Option<BitField>,
    pub touch_probe_positions: [Option<BitField>; 4],
    pub position: Option<BitField>,
    pub velocity: Option<BitField>,
    pub torque: Option<BitField>,
}

/// An object that an axis requires is not in the process data.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("object {} is not in the process data", address(*index, *sub))]
pub struct NotMapped {
    pub index: u16,
    pub sub: u8,
}

impl AxisBits {
    pub fn new(layout: &Layout, region: &DeviceRegion) -> Result<Self, NotMapped> {
        let out = |index| {
            layout
                .rx_field(index, 0)
                .and_then(|f| BitField::new(f, region.offset, region.out_len))
        };
        let inp = |index| {
            layout
                .tx_field(index, 0)
                .and_then(|f| BitField::new(f, region.offset, region.in_len))
        };
        Ok(Self {
            controlword: out(0x6040).ok_or(NotMapped {
                index: 0x6040,
                sub: 0,
            })?,
            statusword: inp(0x6041).ok_or(NotMapped {
                index: 0x6041,
                sub: 0,
            })?,
            mode: out(0x6060),
            mode_display: inp(0x6061),
            target_position: out(0x607a),
            target_velocity: out(0x60ff),
            target_torque: out(0x6071),
            velocity_offset: out(0x60b1),
            torque_offset: out(0x60b2),
            error_code: inp(0x603f),
            profile_velocity: out(0x6081),
            profile_acceleration: out(0x6083),
            profile_deceleration: out(0x6084),
            touch_probe_function: out(0x60b8),
            touch_probe_status: inp(0x60b9),
            touch_probe_positions: [0x60ba, 0x60bb, 0x60bc, 0x60bd].map(inp),
            position: inp(0x6064),
            velocity: inp(0x606c),
            torque: inp(0x6077),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn signals_convert_to_their_numeric_format() {
        let bits = BitField {
            byte: 1,
            shift: 3,
            len: 1,
        };
        let mut image = [0_u8; 8];
        let flag = SignalBits {
            bits,
            kind: NumericFormat::Unsigned,
        };
        flag.set(&mut image, 1.0);
        assert_eq!((image[1], flag.get(&image)), (0x08, 1.0));
        let bits = BitField {
            byte: 2,
            shift: 0,
            len: 16,
        };
        for (kind, value, raw) in [
            (NumericFormat::Signed, -2.0, 0xfffe_u16),
            (NumericFormat::Unsigned, 65_534.0, 0xfffe),
            (NumericFormat::Unsigned, -5.0, 0),
            (NumericFormat::Signed, f64::NAN, 0),
        ] {
            let signal = SignalBits { bits, kind };
            signal.set(&mut image, value);
            assert_eq!(image[2..4], raw.to_le_bytes(), "{kind:?} {value}");
        }
        let bits = BitField {
            byte: 4,
            shift: 0,
            len: 32,
        };
        let real = SignalBits {
            bits,
            kind: NumericFormat::Real,
        };
        real.set(&mut image, -0.5);
        assert_eq!(
            (&image[4..], real.get(&image)),
            (&(-0.5_f32).to_le_bytes()[..], -0.5)
        );
    }

    proptest! {
        #[test]
        fn bit_field_round_trips_and_keeps_neighbours(
            byte in 0_usize..8, shift in 0_u8..8, len in 1_u8..=64, value: i64, fill: u8,
        ) {
            let bits = BitField { byte, shift, len };
            let mut image = [fill; 24];
            bits.set(&mut image, value);
            let unused = 64 - u32::from(len);
            prop_assert_eq!(bits.get(&image), (value << unused) >> unused);
            let before = BitField { byte: 0, shift: 0, len: 8 };
            if byte > 0 {
                prop_assert_eq!(before.get(&image) as u8, fill);
            }
            let mut again = image;
            bits.set(&mut again, BitField { byte, shift, len }.get(&[fill; 24]));
            prop_assert_eq!(again, [fill; 24]);
        }
    }
}
