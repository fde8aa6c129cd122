//! What a device's objects are called, made of and hold: parameters by name or number, kept in files, compared and written
//! back. MAY BLOCK AND ALLOCATE.
//!
//! - [`kind`], [`value`]: data types, and values as text;
//! - [`find`]: an object by its number or name;
//! - [`learn`]: a dictionary from the device itself (SDO Information), in the form that ESI files' have;
//! - [`collect`]: every readable object with its value;
//! - [`dump`]: those in a file;
//! - [`rules`]: which of them a restore writes, and in which order;
//! - [`compare`], [`restore`]: two dictionaries against each other, one into a device;
//! - [`command`]: "save" and "load" (0x1010, 0x1011).

use ecaxis_esi::{Dictionary, Object, ObjectItem, Writable};

use crate::mailbox::ObjectAddress;

pub mod collect;
pub mod command;
pub mod compare;
pub mod dump;
pub mod find;
pub mod kind;
pub mod learn;
pub mod restore;
pub mod rules;
#[cfg(test)]
mod tests;
pub mod value;

pub use kind::{DataType, Kind};
pub use value::ValueError;

/// One subindex with its value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parameter {
    pub at: ObjectAddress,
    pub name: String,
    pub data_type: DataType,
    /// It can be written in PreOp.
    pub writable: bool,
    pub value: Vec<u8>,
}

impl Parameter {
    #[must_use]
    pub fn shown(&self) -> String {
        self.data_type.show(&self.value)
    }
}

/// Every subindex with its object.
pub fn items(dictionary: &Dictionary) -> impl Iterator<Item = (&Object, &ObjectItem)> {
    let objects = dictionary.objects.iter();
    objects.flat_map(|object| object.items.iter().map(move |item| (object, item)))
}

#[must_use]
pub fn type_of(item: &ObjectItem) -> DataType {
    DataType::named(&item.type_name, item.bit_len).unwrap_or(DataType::BYTES)
}

/// Of a variable its own, of a subindex with the object's before it.
#[must_use]
pub fn name_of(object: &Object, item: &ObjectItem) -> String {
    if object.items.len() == 1 || item.name.is_empty() || item.name == object.name {
        object.name.to_string()
    } else {
        format!("{}: {}", object.name, item.name)
    }
}

#[must_use]
pub fn writable_in_pre_op(item: &ObjectItem) -> bool {
    match item.access.write {
        Writable::Never => false,
        Writable::Always => true,
        Writable::Only { pre_op, .. } => pre_op,
    }
}
