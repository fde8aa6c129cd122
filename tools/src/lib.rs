//! Work on a bus or on files without a run.
//!
//! - [`scan`]: the SubDevices of a segment, and a machine file generated from them;
//! - [`compare`]: compares a machine file with a bus;
//! - [`eni`]: network descriptions (ENI) of other configuration tools and MainDevices;
//! - [`firmware`]: firmware updates;
//! - [`doctor`]: checks of host settings that delay the cycle;
//! - [`host`]: the state of a computer from its files;
//! - [`mod@bench`]: the measurements of the benchmark;
//! - [`analyze`]: analysis of recordings;
//! - [`document`]: reports as data, as text and as HTML;
//! - [`tune`]: frequency response and gains of an axis.

#![forbid(unsafe_code)]

pub mod analyze;
pub mod bench;
pub mod compare;
pub mod doctor;
pub mod document;
pub mod eni;
pub mod firmware;
pub mod host;
pub mod scan;
pub mod tune;
