//! The mailbox clients against a small SDO and file server that shares no code with them.

mod during_operation;
mod errors;
mod foe;
mod gateway;
mod hostile;
mod info;
mod start_up;
mod transfers;
