//! Parameters of a device: found by name or number, and saved to files. `acyclic::parameters` reads and
//! writes them.
//!
//! - [`class`]: what may be copied from one device to another;
//! - [`dump`]: parameter files;
//! - [`kept`]: the parameter file of a device of a machine;
//! - [`lookup`]: finds an object by number or name;
//! - [`meaning`](mod@meaning): the text of a word or code.

use ecaxis_esi::{Dictionary, Object, ObjectItem, Writable};

use crate::mailbox::NamedObject;

pub mod class;
pub mod dump;
pub mod kept;
pub mod lookup;
pub mod meaning;

pub use ecaxis_ecat::data_type::{DataType, Kind};
pub use ecaxis_ecat::value::ValueError;

/// One subindex with its value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parameter {
    pub at: NamedObject,
    pub name: String,
    pub data_type: DataType,
    /// True if it is writable in PreOp.
    pub writable: bool,
    pub value: Vec<u8>,
}

impl Parameter {
    #[must_use]
    pub fn shown(&self) -> String {
        self.data_type.show(&self.value)
    }

    /// Returns the text of a word or code.
    #[must_use]
    pub fn meaning(&self) -> Option<String> {
        meaning::meaning(self.at.index, self.at.sub, &self.value)
    }
}

/// Iterates over all subindices with their objects.
pub fn items(dictionary: &Dictionary) -> impl Iterator<Item = (&Object, &ObjectItem)> {
    let objects = dictionary.objects.iter();
    objects.flat_map(|object| object.items.iter().map(move |item| (object, item)))
}

#[must_use]
pub fn type_of(item: &ObjectItem) -> DataType {
    DataType::named(&item.type_name, item.bit_len).unwrap_or(DataType::BYTES)
}

/// Returns the name of a variable, or the name of a subindex with the object's name as prefix.
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
