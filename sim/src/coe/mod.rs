//! CANopen over EtherCAT: the object dictionary and the server that answers for it.

pub mod store;
