//! Typed indices of a machine's lists, and vectors that accept only their own index.
//!
//! ```
//! use ecaxis_ecat::index::{AxisIndex, IndexVec};
//!
//! let names: IndexVec<AxisIndex, &str> = vec!["x", "y"].into();
//! assert_eq!(names[AxisIndex(1)], "y");
//! assert_eq!(names.get(AxisIndex(2)), None);
//! ```

use alloc::vec::Vec;
use core::marker::PhantomData;
use core::ops::{Deref, DerefMut, Index, IndexMut};
use core::slice;

macro_rules! index {
    ($($(#[$doc:meta])+ $name:ident)+) => {$(
        $(#[$doc])+
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
        pub struct $name(pub usize);

        impl From<usize> for $name {
            fn from(index: usize) -> Self {
                Self(index)
            }
        }

        impl From<$name> for usize {
            fn from(index: $name) -> Self {
                index.0
            }
        }
    )+};
}

index! {
    /// The index of a SubDevice in the order of the machine file; not its position on the bus.
    DeviceIndex
    /// The index of an axis: its place among the SubDevices with an axis.
    AxisIndex
    /// The index of a reaction group. The first group holds all SubDevices without a named group.
    GroupIndex
    /// The index of a line shaft.
    LineShaftIndex
}

impl GroupIndex {
    /// The group whose stop is the stop of the machine.
    pub const MACHINE: Self = Self(0);
}

/// A vector indexed by `I` only.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IndexVec<I, T> {
    items: Vec<T>,
    index: PhantomData<I>,
}

impl<I: From<usize> + Into<usize>, T> IndexVec<I, T> {
    /// Returns an item.
    pub fn get(&self, index: I) -> Option<&T> {
        self.items.get(index.into())
    }

    /// Returns an item for changes.
    pub fn get_mut(&mut self, index: I) -> Option<&mut T> {
        self.items.get_mut(index.into())
    }

    /// Returns all indices in order. They do not borrow the vector.
    pub fn indices(&self) -> impl Iterator<Item = I> + Clone + use<I, T> {
        (0..self.items.len()).map(I::from)
    }

    /// Returns the items with their indices.
    pub fn enumerate(&self) -> impl Iterator<Item = (I, &T)> {
        self.indices().zip(&self.items)
    }

    /// Returns the items with their indices, for changes.
    pub fn enumerate_mut(&mut self) -> impl Iterator<Item = (I, &mut T)> {
        self.indices().zip(&mut self.items)
    }
}

impl<I, T> From<Vec<T>> for IndexVec<I, T> {
    fn from(items: Vec<T>) -> Self {
        let index = PhantomData;
        Self { items, index }
    }
}

impl<I, T> FromIterator<T> for IndexVec<I, T> {
    fn from_iter<A: IntoIterator<Item = T>>(items: A) -> Self {
        Vec::from_iter(items).into()
    }
}

impl<I, T> Default for IndexVec<I, T> {
    fn default() -> Self {
        Vec::new().into()
    }
}

impl<I, T> Deref for IndexVec<I, T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.items
    }
}

impl<I, T> DerefMut for IndexVec<I, T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.items
    }
}

impl<I: Into<usize>, T> Index<I> for IndexVec<I, T> {
    type Output = T;

    fn index(&self, index: I) -> &T {
        &self.items[index.into()]
    }
}

impl<I: Into<usize>, T> IndexMut<I> for IndexVec<I, T> {
    fn index_mut(&mut self, index: I) -> &mut T {
        &mut self.items[index.into()]
    }
}

impl<'a, I, T> IntoIterator for &'a IndexVec<I, T> {
    type Item = &'a T;
    type IntoIter = slice::Iter<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.items.iter()
    }
}

impl<'a, I, T> IntoIterator for &'a mut IndexVec<I, T> {
    type Item = &'a mut T;
    type IntoIter = slice::IterMut<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.items.iter_mut()
    }
}
