//! Registers of an EtherCAT SubDevice Controller (ETG.1000.4, clause 6; names as in ESC data
//! sheets).
//!
//! Each constant is the physical address of a register's first byte.
//!
//! ```
//! use ecaxis_ecat::registers::{SYNC_MANAGER, SYNC_MANAGER_LEN};
//!
//! // SyncManager 2 holds the outputs of a device with mailboxes.
//! assert_eq!(SYNC_MANAGER + 2 * SYNC_MANAGER_LEN, 0x0810);
//! ```

/// ESC type; revision, build, FMMUs, SyncManagers, RAM and ports follow.
pub const TYPE: u16 = 0x0000;
/// The number of FMMUs.
pub const FMMU_COUNT: u16 = 0x0004;
/// ESC features supported.
pub const FEATURES: u16 = 0x0008;
/// Configured station address.
pub const STATION_ADDRESS: u16 = 0x0010;
/// DL control: forwarding rule, temporary use, and the loop of each port.
pub const DL_CONTROL: u16 = 0x0100;
/// DL control, second byte: two bits for the loop of each port.
pub const DL_CONTROL_LOOPS: u16 = 0x0101;
/// DL status: links and loops of the ports.
pub const DL_STATUS: u16 = 0x0110;
/// AL control: the state that the MainDevice requests.
pub const AL_CONTROL: u16 = 0x0120;
/// AL status: the state of the device.
pub const AL_STATUS: u16 = 0x0130;
/// AL status code: why a state change failed.
pub const AL_STATUS_CODE: u16 = 0x0134;
/// ESC configuration: bit 0 says that the device emulates its states.
pub const ESC_CONFIGURATION: u16 = 0x0141;
/// RX error counters: two bytes for each port.
pub const RX_ERROR_COUNTERS: u16 = 0x0300;
/// Forwarded RX error counters: one byte for each port.
pub const FORWARDED_ERROR_COUNTERS: u16 = 0x0308;
/// ECAT processing unit error counter.
pub const PROCESSING_UNIT_ERRORS: u16 = 0x030c;
/// PDI error counter.
pub const PDI_ERRORS: u16 = 0x030d;
/// Lost link counters: one byte for each port.
pub const LOST_LINK_COUNTERS: u16 = 0x0310;
/// Watchdog divider.
pub const WATCHDOG_DIVIDER: u16 = 0x0400;
/// Watchdog time of the PDI.
pub const WATCHDOG_TIME_PDI: u16 = 0x0410;
/// Watchdog time of the process data.
pub const WATCHDOG_TIME_PROCESS_DATA: u16 = 0x0420;
/// EEPROM configuration: who has access.
pub const EEPROM_CONFIGURATION: u16 = 0x0500;
/// EEPROM control and status.
pub const EEPROM_CONTROL: u16 = 0x0502;
/// EEPROM word address.
pub const EEPROM_ADDRESS: u16 = 0x0504;
/// EEPROM data.
pub const EEPROM_DATA: u16 = 0x0508;
/// FMMU 0.
pub const FMMU: u16 = 0x0600;
/// SyncManager 0.
pub const SYNC_MANAGER: u16 = 0x0800;
/// Bytes from one SyncManager to the next.
pub const SYNC_MANAGER_LEN: u16 = 8;
/// Status of SyncManager 0; the other SyncManagers follow every [`SYNC_MANAGER_LEN`] bytes.
pub const SYNC_MANAGER_STATUS: u16 = 0x0805;
/// Receive time of port 0; writing it latches the times of all ports.
pub const DC_RECEIVE_TIME: u16 = 0x0900;
/// System time.
pub const DC_SYSTEM_TIME: u16 = 0x0910;
/// Receive time of the processing unit.
pub const DC_RECEIVE_TIME_UNIT: u16 = 0x0918;
/// System time offset.
pub const DC_SYSTEM_TIME_OFFSET: u16 = 0x0920;
/// System time delay.
pub const DC_SYSTEM_TIME_DELAY: u16 = 0x0928;
/// System time difference.
pub const DC_SYSTEM_TIME_DIFFERENCE: u16 = 0x092c;
/// Speed counter start.
pub const DC_SPEED_COUNTER_START: u16 = 0x0930;
/// Cyclic unit control: whether MainDevice or PDI controls SYNC and latch units.
pub const DC_CYCLIC_CONTROL: u16 = 0x0980;
/// Activation of the SYNC unit.
pub const DC_ACTIVATION: u16 = 0x0981;
/// Start time of cyclic operation.
pub const DC_START_TIME: u16 = 0x0990;
/// SYNC0 cycle time.
pub const DC_SYNC0_CYCLE: u16 = 0x09a0;
/// SYNC1 cycle time: the time from SYNC0 to SYNC1.
pub const DC_SYNC1_CYCLE: u16 = 0x09a4;
