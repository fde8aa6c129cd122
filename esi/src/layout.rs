//! Bit offsets of mapped objects. PDOs of one SyncManager are packed bit by bit in assignment
//! order. Each SyncManager starts at a byte.
//!
//! ```
//! use ecaxis_esi::Layout;
//!
//! # let bytes = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/io.xml"));
//! # let file = ecaxis_esi::parse(bytes)?;
//! let device = &file.devices[0];
//! let layout = Layout::new(device, &device.rx_pdos, &device.tx_pdos)?;
//! assert_eq!((layout.rx_bytes(), layout.tx_bytes()), (1, 1));
//! assert_eq!(layout.rx_field(0x7000, 1).unwrap().bit_offset, 0);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use crate::model::{Device, FmmuUse, Pdo, SmUse};
use crate::select::SelectError;

/// The lowest register that process data may use. Terminals map registers: outputs at 0x0F00,
/// system and latch times from 0x0910. Registers below configure the controller itself.
const FIRST_ADDRESS: u16 = 0x0900;
const ADDRESS_SPACE: u32 = 0x1_0000;
/// Start of the process memory.
const PROCESS_MEMORY: u16 = 0x1000;

/// The process data layout of one device.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Layout {
    /// Sorted by SyncManager number. Couplers have several SyncManagers in one direction.
    pub outputs: Vec<SmLayout>,
    /// The SyncManagers of the inputs, sorted by number.
    pub inputs: Vec<SmLayout>,
    /// The outputs in wire order.
    pub rx: Vec<Field>,
    /// The inputs in wire order.
    pub tx: Vec<Field>,
    /// The PDOs of the outputs in wire order.
    pub rx_pdos: Vec<PdoLayout>,
    /// The PDOs of the inputs in wire order.
    pub tx_pdos: Vec<PdoLayout>,
    /// True if the objects are IDNs (SoE), and their subindices the drives of the device.
    pub idns: bool,
}

/// The layout of one process data SyncManager.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SmLayout {
    /// The SyncManager number.
    pub sm: u8,
    /// The physical start address.
    pub start_address: u16,
    /// The ControlByte in the ESI, register 0x0804 of the SyncManager.
    pub control_byte: u8,
    /// Writes of this area trigger the watchdog, whatever the ESI says.
    pub watched: bool,
    /// The length in bytes.
    pub len: u16,
    /// The FMMU that the ESI assigns to this SyncManager.
    pub fmmu: Option<u8>,
}

impl SmLayout {
    /// Bit 6 of the ControlByte (ETG.1000.4, table 58): writing the area triggers the watchdog.
    pub const WATCHDOG_TRIGGER: u8 = 0x40;

    /// Returns the ControlByte that a MainDevice writes.
    #[must_use]
    pub const fn control(&self) -> u8 {
        match self.watched {
            true => self.control_byte | Self::WATCHDOG_TRIGGER,
            false => self.control_byte,
        }
    }

    /// True if writing the area triggers the watchdog.
    #[must_use]
    pub const fn has_trigger(&self) -> bool {
        self.control() & Self::WATCHDOG_TRIGGER != 0
    }

    /// True for three-buffer mode, in which each side always owns one buffer.
    fn is_buffered(&self) -> bool {
        self.start_address >= PROCESS_MEMORY && self.control_byte & 0x03 == 0
    }
}

/// The bits of one assigned PDO, gaps included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PdoLayout {
    /// The index of the PDO.
    pub index: u16,
    /// The offset as in [`Field::bit_offset`].
    pub bit_offset: u32,
    /// The length in bits.
    pub bit_len: u32,
}

/// One mapped object. Gaps have no `Field`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// The index of the PDO.
    pub pdo: u16,
    /// The index of the object.
    pub index: u16,
    /// The subindex.
    pub sub: u8,
    /// The offset from the start of the device's process data in this direction, across all
    /// SyncManagers.
    pub bit_offset: u32,
    /// The length in bits.
    pub bit_len: u16,
    /// The name in the ESI.
    pub name: String,
    /// The data type in the ESI.
    pub data_type: String,
}

impl Layout {
    /// Lays out `rx` and `tx`. Both are in assignment order, and each PDO names its SyncManager.
    pub fn new(device: &Device, rx: &[Pdo], tx: &[Pdo]) -> Result<Self, SelectError> {
        let (outputs, rx, rx_pdos) = direction(device, rx, FmmuUse::Outputs)?;
        let (inputs, tx, tx_pdos) = direction(device, tx, FmmuUse::Inputs)?;
        let layout = Self {
            outputs,
            inputs,
            rx,
            tx,
            rx_pdos,
            tx_pdos,
            idns: false,
        };
        layout.check_addresses(device)?;
        // Digital I/O controllers without a processor latch single bytes and do not need buffers.
        if device.mailbox.is_some() {
            layout.check_memory()?;
        }
        Ok(layout)
    }

    /// Returns the length of the outputs in bytes.
    #[must_use]
    pub fn rx_bytes(&self) -> usize {
        self.outputs.iter().map(|sm| usize::from(sm.len)).sum()
    }

    /// Returns the length of the inputs in bytes.
    #[must_use]
    pub fn tx_bytes(&self) -> usize {
        self.inputs.iter().map(|sm| usize::from(sm.len)).sum()
    }

    /// Returns the output with this object.
    #[must_use]
    pub fn rx_field(&self, index: u16, sub: u8) -> Option<&Field> {
        self.rx
            .iter()
            .find(|field| field.index == index && field.sub == sub)
    }

    /// Returns the input with this object.
    #[must_use]
    pub fn tx_field(&self, index: u16, sub: u8) -> Option<&Field> {
        self.tx
            .iter()
            .find(|field| field.index == index && field.sub == sub)
    }

    /// Returns the outputs that map an object of an earlier PDO again, each after the first field
    /// of that object. Equal fields of one PDO are not repetitions but samples (oversampling).
    pub fn repeated_outputs(&self) -> impl Iterator<Item = (&Field, &Field)> {
        /// Lower indices are data types, which serve as padding (ETG.1000.6, dummy mapping).
        const FIRST_OBJECT: u16 = 0x1000;
        self.rx.iter().filter_map(|field| {
            let first = self.rx_field(field.index, field.sub)?;
            let repeats = first.pdo != field.pdo && field.index >= FIRST_OBJECT;
            repeats.then_some((first, field))
        })
    }

    /// Checks that the memory of each used SyncManager is valid, including the mailbox
    /// SyncManagers.
    fn check_addresses(&self, device: &Device) -> Result<(), SelectError> {
        let has_mailbox = device.mailbox.is_some();
        let used = |number: u8| {
            let mut all = self.outputs.iter().chain(&self.inputs);
            all.find(|sm| sm.sm == number).map(|sm| {
                let buffers = if has_mailbox && sm.is_buffered() {
                    3
                } else {
                    1
                };
                buffers * u32::from(sm.len)
            })
        };
        for (number, sm) in (0..=u8::MAX).zip(&device.sync_managers) {
            let mailbox = has_mailbox && matches!(sm.usage, SmUse::MBoxOut | SmUse::MBoxIn);
            let len = used(number).or_else(|| mailbox.then_some(u32::from(sm.default_size)));
            if let Some(len) = len
                && (sm.start_address < FIRST_ADDRESS
                    || u32::from(sm.start_address) + len > ADDRESS_SPACE)
            {
                return Err(SelectError::SyncManagerOutside {
                    sm: number,
                    position: sm.position,
                    start: sm.start_address,
                    len,
                });
            }
        }
        Ok(())
    }

    /// Checks the device memory. A buffered SyncManager occupies three times its length.
    fn check_memory(&self) -> Result<(), SelectError> {
        let all = || self.outputs.iter().chain(&self.inputs);
        for sm in all().filter(|sm| sm.is_buffered()) {
            let end = u32::from(sm.start_address) + 3 * u32::from(sm.len);
            let hit = all().find(|other| {
                other.start_address > sm.start_address
                    && u32::from(other.start_address) < end
                    && other.len > 0
            });
            if let Some(other) = hit {
                return Err(SelectError::SyncManagersOverlap {
                    sm: sm.sm,
                    start: sm.start_address,
                    len: sm.len,
                    other: other.sm,
                    other_start: other.start_address,
                });
            }
        }
        Ok(())
    }
}

/// The SyncManagers, fields and PDOs of one direction.
type DirectionLayout = (Vec<SmLayout>, Vec<Field>, Vec<PdoLayout>);

fn direction(
    device: &Device,
    pdos: &[Pdo],
    usage: FmmuUse,
) -> Result<DirectionLayout, SelectError> {
    let mut numbers: Vec<u8> = pdos.iter().filter_map(|pdo| pdo.sm).collect();
    numbers.sort_unstable();
    numbers.dedup();
    let fmmus: Vec<u8> = (0..=u8::MAX)
        .zip(&device.fmmus)
        .filter(|(_, fmmu)| fmmu.usage == usage)
        .map(|(number, _)| number)
        .collect();
    let (mut sms, mut fields, mut laid_out) = (Vec::new(), Vec::new(), Vec::new());
    let mut offset = 0u32;
    for number in numbers {
        let Some(sm) = device.sync_managers.get(usize::from(number)) else {
            continue;
        };
        let start = offset;
        for pdo in pdos.iter().filter(|pdo| pdo.sm == Some(number)) {
            let first_bit = offset;
            for entry in &pdo.entries {
                if !entry.is_gap() {
                    fields.push(Field {
                        pdo: pdo.index,
                        index: entry.index,
                        sub: entry.sub,
                        bit_offset: offset,
                        bit_len: entry.bit_len,
                        name: entry.name.to_string(),
                        data_type: entry.data_type.to_string(),
                    });
                }
                offset = offset.saturating_add(u32::from(entry.bit_len));
            }
            laid_out.push(PdoLayout {
                index: pdo.index,
                bit_offset: first_bit,
                bit_len: offset - first_bit,
            });
        }
        let bytes = (offset - start).div_ceil(8);
        let max = sm
            .max_size
            .filter(|max| *max > 0)
            .map_or(u32::from(u16::MAX), u32::from);
        let direction = match usage {
            FmmuUse::Outputs => "outputs",
            _ => "inputs",
        };
        let len = u16::try_from(bytes).ok().filter(|_| bytes <= max).ok_or(
            SelectError::SyncManagerFull {
                sm: number,
                direction,
                len: bytes,
                max,
            },
        )?;
        offset = start.saturating_add(bytes.saturating_mul(8));
        if len > 0 {
            let meant = fmmus.iter().find(|&&fmmu| {
                let of_file = device.fmmus.get(usize::from(fmmu));
                of_file.is_some_and(|fmmu| fmmu.sm == Some(number))
            });
            let next = || fmmus.get(sms.len()).or(fmmus.last());
            let fmmu = meant.or_else(next).copied();
            sms.push(SmLayout {
                sm: number,
                start_address: sm.start_address,
                control_byte: sm.control_byte,
                watched: false,
                len,
                fmmu,
            });
        }
    }
    Ok((sms, fields, laid_out))
}
