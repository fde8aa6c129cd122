//! Mailbox protocols and their start-up commands.

use ecaxis_ecat::mailbox::soe::Idn;

use super::{Position, SlotDependence};

/// `Mailbox`: the supported protocols.
#[derive(Debug, Clone, Default)]
pub struct Mailbox {
    /// `DataLinkLayer`: repetition of lost mailbox reads.
    pub data_link_layer: bool,
    /// CANopen over EtherCAT; `None`: not supported.
    pub coe: Option<Coe>,
    /// File access over EtherCAT.
    pub foe: bool,
    /// Ethernet over EtherCAT; `None`: not supported.
    pub eoe: Option<Eoe>,
    /// Servo drive profile over EtherCAT; `None`: not supported.
    pub soe: Option<Soe>,
    /// ADS over EtherCAT.
    pub aoe: bool,
    /// Vendor-specific protocol over EtherCAT.
    pub voe: bool,
}

/// `EoE`: properties of Ethernet over EtherCAT. `None`: the ESI does not say.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Eoe {
    /// `IP`: the device takes an IP address.
    pub ip: Option<bool>,
    /// `MAC`: the device takes a MAC address.
    pub mac: Option<bool>,
    /// `TimeStamp`: the device sends time stamps.
    pub time_stamp: Option<bool>,
}

/// `CoE`: properties of CANopen over EtherCAT.
#[derive(Debug, Clone, Default)]
pub struct Coe {
    /// `SdoInfo`: the SDO Information service.
    pub sdo_info: bool,
    /// The PDO assignment (0x1C12/0x1C13) is writable.
    pub pdo_assign: bool,
    /// The PDO contents (0x16xx/0x1Axx) are writable.
    pub pdo_config: bool,
    /// `PdoUpload`: the device has its own PDO contents.
    pub pdo_upload: bool,
    /// `CompleteAccess`: access to all subindices at once.
    pub complete_access: bool,
    /// `SegmentedSdo`: transfers longer than a mailbox.
    pub segmented_sdo: bool,
    /// `DiagHistory`: the diagnosis history 0x10F3.
    pub diag_history: bool,
    /// `InitCmd` in file order.
    pub init_cmds: Vec<InitCmd>,
}

/// `SoE`: properties of the servo drive profile over EtherCAT.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Soe {
    /// `ChannelCount`: the number of drives in the device; `None`: not in the file.
    pub channel_count: Option<u8>,
    /// `DriveFollowsBit3Support`: bit 3 of the drive status word reports that the drive follows its
    /// command values.
    pub follows_bit: bool,
    /// `InitCmd` in file order.
    pub init_cmds: Vec<IdnInitCmd>,
}

/// `SoE/InitCmd`: an IDN that the vendor requires at a state transition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdnInitCmd {
    /// The position of the element.
    pub position: Position,
    /// `IP`, `PS`, `SO`, …; one command may have several.
    pub transitions: Vec<String>,
    /// `Chn`: the drive of the device, from 0.
    pub drive: u8,
    /// `IDN`.
    pub idn: Idn,
    /// The value.
    pub data: Vec<u8>,
    /// `Comment`.
    pub comment: String,
}

/// `InitCmd`: an SDO download that the vendor requires at a state transition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InitCmd {
    /// The position of the element.
    pub position: Position,
    /// `IP`, `PS`, `SO`, …; one command may have several.
    pub transitions: Vec<String>,
    /// The index.
    pub index: u16,
    /// The dependence of the index on the slot.
    pub depends_on: SlotDependence,
    /// The subindex.
    pub sub: u8,
    /// True if the command writes all subindices at once.
    pub complete_access: bool,
    /// The user may not change this command.
    pub fixed: bool,
    /// A module's command for the same object replaces this command of the device.
    pub overwritten_by_module: bool,
    /// The value.
    pub data: Vec<u8>,
    /// `AdaptAutomatically`: the data follow the configuration. The data in the file belong to the
    /// vendor's default.
    pub adapts: bool,
    /// `Comment`.
    pub comment: String,
}
