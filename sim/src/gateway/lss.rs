//! The frames of the layer setting services (CiA 305) that master and nodes share.

/// The identifiers of requests and answers.
pub(super) const MASTER: u16 = 0x7e5;
pub(super) const SLAVE: u16 = 0x7e4;
/// The number of a node that has none.
pub(super) const UNNUMBERED: u8 = 0xff;

/// Command specifiers.
pub(super) mod cs {
    pub(in super::super) const SWITCH_GLOBAL: u8 = 0x04;
    pub(in super::super) const SET_NUMBER: u8 = 0x11;
    pub(in super::super) const SET_BIT_TIMING: u8 = 0x13;
    pub(in super::super) const ACTIVATE_BIT_TIMING: u8 = 0x15;
    pub(in super::super) const STORE: u8 = 0x17;
    pub(in super::super) const SELECT_VENDOR: u8 = 0x40;
    pub(in super::super) const SELECT_SERIAL: u8 = 0x43;
    pub(in super::super) const SELECTED: u8 = 0x44;
    pub(in super::super) const IDENTIFY_VENDOR: u8 = 0x46;
    pub(in super::super) const IDENTIFY_SERIAL_HIGH: u8 = 0x4b;
    pub(in super::super) const IDENTIFY_UNNUMBERED: u8 = 0x4c;
    pub(in super::super) const IDENTIFIED: u8 = 0x4f;
    pub(in super::super) const IS_UNNUMBERED: u8 = 0x50;
    pub(in super::super) const INQUIRE_VENDOR: u8 = 0x5a;
    pub(in super::super) const INQUIRE_SERIAL: u8 = 0x5d;
    pub(in super::super) const INQUIRE_NUMBER: u8 = 0x5e;
}
