//! The registers of a device's process data: its SyncManagers and FMMUs (ETG.1000.4, 6.3 and 6.6).
//! Pure: bring-up writes them, an exported ENI contains them.

use ecaxis_ecat::registers;
use ecaxis_esi::layout::SmLayout;

use crate::config::DeviceConfig;
use crate::report::Cause;
use crate::rt::image::DeviceRegion;

const FMMU_SIZE: u16 = 16;
/// The activation bytes of a SyncManager and of an FMMU.
pub(super) const SM_ACTIVATE: u16 = 6;
const FMMU_ACTIVATE: u16 = 12;

/// The ControlBytes of a device's SyncManagers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ControlBytes {
    /// With the watchdog trigger that the machine file demands.
    #[default]
    Watched,
    /// As in the ESI.
    Esi,
}

impl ControlBytes {
    const fn of(self, sm: &SmLayout) -> u8 {
        match self {
            Self::Watched => sm.control(),
            Self::Esi => sm.control_byte,
        }
    }
}

/// Bytes for consecutive registers of one device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RegisterBlock {
    /// The address of the first byte.
    pub register: u16,
    pub data: Vec<u8>,
    /// The activation byte that is 0 in `data` and 1 in Op.
    pub op_only: Option<u16>,
}

/// The logical memory of one FMMU.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Mapping {
    logical: u32,
    physical: u16,
    len: u16,
    /// [`READ`] or [`WRITE`].
    kind: u8,
    /// Enabled in Op only.
    op_only: bool,
}

const READ: u8 = 1;
const WRITE: u8 = 2;

/// The SyncManagers of the process data with one FMMU each, and the FMMU of the mailbox status.
/// Outputs and inputs start at the same logical address.
#[derive(Debug)]
pub struct ProcessDataPlan {
    pub sync_managers: Vec<RegisterBlock>,
    mappings: Vec<Mapping>,
    /// The logical address of the mailbox status, its FMMU in the ESI, and its SyncManager.
    status: Option<(u32, (u8, u8))>,
}

impl ProcessDataPlan {
    /// `region`, `status`: the process data and the mailbox status in the process image.
    #[must_use]
    pub fn new(
        config: &DeviceConfig,
        control: ControlBytes,
        region: Option<DeviceRegion>,
        status: Option<u32>,
    ) -> Self {
        let layout = &config.selection.layout;
        let (mut sync_managers, mut mappings) = (Vec::new(), Vec::new());
        for (sms, kind) in [(&layout.outputs, WRITE), (&layout.inputs, READ)] {
            let mut logical = region.map_or(0, |region| region.logical);
            for sm in sms {
                let register =
                    registers::SYNC_MANAGER + registers::SYNC_MANAGER_LEN * u16::from(sm.sm);
                let op_only = config.device.op_only(sm);
                let late = op_only.sync_manager && sm.len > 0;
                let mut data = sync_manager(sm, control.of(sm));
                if late {
                    data[usize::from(SM_ACTIVATE)] = 0;
                }
                sync_managers.push(RegisterBlock {
                    register,
                    data: data.to_vec(),
                    op_only: late.then_some(register + SM_ACTIVATE),
                });
                if sm.len > 0 {
                    mappings.push(Mapping {
                        logical,
                        physical: sm.start_address,
                        len: sm.len,
                        kind,
                        op_only: op_only.fmmu,
                    });
                    logical = logical.saturating_add(u32::from(sm.len));
                }
            }
        }
        Self {
            sync_managers,
            mappings,
            status: status.zip(config.device.mailbox_status_fmmu()),
        }
    }

    pub(super) fn needs_fmmus(&self) -> bool {
        !self.mappings.is_empty() || self.status.is_some()
    }

    /// Returns the FMMUs for a controller that has `available` of them. SyncManagers whose areas
    /// adjoin share an FMMU if there are too few. The mailbox status gets an FMMU only if one is
    /// left.
    ///
    /// # Errors
    /// [`Cause::Fmmus`] if the controller has too few FMMUs.
    pub fn fmmus(&self, available: usize) -> Result<Vec<RegisterBlock>, Cause> {
        let mut mappings = self.mappings.clone();
        if mappings.len() > available {
            share_fmmus(&mut mappings);
        }
        let needed = mappings.len();
        if needed > available {
            return Err(Cause::Fmmus { needed, available });
        }
        let numbered = mappings.iter().enumerate();
        let mut fmmus: Vec<_> = numbered.map(|(n, mapping)| fmmu(n, mapping)).collect();
        if let Some((logical, (number, sm))) = self.status {
            // The ESI's number, unless the process data already uses it.
            let own = usize::from(number).max(needed);
            let number = if own < available { own } else { needed };
            let mapping = Mapping {
                logical,
                physical: registers::SYNC_MANAGER_STATUS
                    + registers::SYNC_MANAGER_LEN * u16::from(sm),
                len: 1,
                kind: READ,
                op_only: false,
            };
            if number < available {
                fmmus.push(fmmu(number, &mapping));
            }
        }
        Ok(fmmus)
    }
}

/// Joins mappings that adjoin in logical and in physical memory.
fn share_fmmus(mappings: &mut Vec<Mapping>) {
    mappings.dedup_by(|next, last| {
        let len = u32::from(last.len);
        let adjoins = (next.kind, next.op_only) == (last.kind, last.op_only)
            && u32::from(next.physical) == u32::from(last.physical) + len
            && u64::from(next.logical) == u64::from(last.logical) + u64::from(len);
        let sum = last.len.checked_add(next.len);
        if let (true, Some(sum)) = (adjoins, sum) {
            last.len = sum;
            return true;
        }
        false
    });
}

/// A SyncManager without data stays disabled: devices reject an active one of length 0.
fn sync_manager(sm: &SmLayout, control: u8) -> [u8; registers::SYNC_MANAGER_LEN as usize] {
    let [p0, p1] = sm.start_address.to_le_bytes();
    let [n0, n1] = sm.len.to_le_bytes();
    [p0, p1, n0, n1, control, 0, u8::from(sm.len > 0), 0]
}

fn fmmu(number: usize, mapping: &Mapping) -> RegisterBlock {
    let number = u16::try_from(number).unwrap_or(u16::MAX / FMMU_SIZE);
    let register = registers::FMMU.saturating_add(FMMU_SIZE.saturating_mul(number));
    let [l0, l1, l2, l3] = mapping.logical.to_le_bytes();
    let [n0, n1] = mapping.len.to_le_bytes();
    let [p0, p1] = mapping.physical.to_le_bytes();
    let (kind, on) = (mapping.kind, u8::from(!mapping.op_only));
    // Start bit 0 to stop bit 7; physical start bit 0.
    let data = [l0, l1, l2, l3, n0, n1, 0, 7, p0, p1, 0, kind, on, 0, 0, 0];
    RegisterBlock {
        register,
        data: data.to_vec(),
        op_only: mapping
            .op_only
            .then(|| register.saturating_add(FMMU_ACTIVATE)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// ETG.1000.4, FMMU: one FMMU maps one contiguous physical area to one contiguous logical area,
    /// in one direction.
    #[test]
    fn share_fmmus_joins_adjoining_areas_of_one_direction() {
        let mapping = |logical, physical, len, kind| Mapping {
            logical,
            physical,
            len,
            kind,
            op_only: false,
        };
        let mut all = vec![
            mapping(0x1_0000, 0x0f00, 1, WRITE),
            mapping(0x1_0001, 0x0f01, 1, WRITE),
            mapping(0x1_0002, 0x0f03, 1, WRITE),
            mapping(0x1_0000, 0x1000, 2, READ),
            mapping(0x1_0002, 0x1002, 4, READ),
        ];
        share_fmmus(&mut all);
        let joined = [
            mapping(0x1_0000, 0x0f00, 2, WRITE),
            mapping(0x1_0002, 0x0f03, 1, WRITE),
            mapping(0x1_0000, 0x1000, 6, READ),
        ];
        assert_eq!(all, joined);
        all[1].op_only = true;
        all[1].physical = 0x0f02;
        share_fmmus(&mut all);
        assert_eq!(all.len(), 3, "one is disabled outside Op");
    }
}
