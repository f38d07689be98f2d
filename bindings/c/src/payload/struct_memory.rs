//! A struct of the caller: read and written at checked offsets only.

use std::{ffi::c_void, ptr};

use super::Layout;
use crate::{status::CallError, text};

/// A struct to read.
#[derive(Clone, Copy)]
pub(super) struct StructMemory<'call> {
    bytes: &'call [MaybePadding],
}

/// A byte of a struct, which may be padding that was never written.
type MaybePadding = std::mem::MaybeUninit<u8>;

/// A struct to write.
pub(super) struct StructMemoryMut<'call> {
    bytes: &'call mut [MaybePadding],
}

impl StructMemory<'_> {
    pub(super) fn new(value: *const c_void, layout: &Layout) -> Result<Self, CallError> {
        // SAFETY: the header requires that a struct of the type's length is valid during the call.
        let bytes = unsafe { text::memory(value.cast::<MaybePadding>(), length(layout)?) };
        bytes.map(|bytes| Self { bytes }).ok_or_else(no_value)
    }

    /// Returns the memory of a nested struct.
    pub(super) fn part(self, offset: usize, size: usize) -> Result<Self, CallError> {
        range(offset, size)
            .and_then(|range| self.bytes.get(range))
            .map(|bytes| Self { bytes })
            .ok_or_else(outside)
    }

    /// Returns the bytes of a value.
    pub(super) fn read<const N: usize>(self, offset: usize) -> Result<[u8; N], CallError> {
        let part = self.part(offset, N)?;
        // SAFETY: `N` bytes are there. The header requires that the fields of a table have been written.
        Ok(unsafe { ptr::read_unaligned(part.bytes.as_ptr().cast::<[u8; N]>()) })
    }

    /// Returns the bytes of a text or of an array of bytes.
    pub(super) fn bytes(&self, offset: usize, size: usize) -> Result<&[u8], CallError> {
        let part = self.part(offset, size)?;
        // SAFETY: `size` bytes are there. The header requires that the fields of a table have been written.
        Ok(unsafe { std::slice::from_raw_parts(part.bytes.as_ptr().cast::<u8>(), size) })
    }
}

impl StructMemoryMut<'_> {
    pub(super) fn new(value: *mut c_void, layout: &Layout) -> Result<Self, CallError> {
        // SAFETY: the header requires that a struct of the type's length is valid, for this call only.
        let bytes = unsafe { text::memory_mut(value.cast::<MaybePadding>(), length(layout)?) };
        bytes.map(|bytes| Self { bytes }).ok_or_else(no_value)
    }

    /// Returns the memory of a nested struct.
    pub(super) fn part(&mut self, offset: usize, size: usize) -> Result<StructMemoryMut<'_>, CallError> {
        range(offset, size)
            .and_then(|range| self.bytes.get_mut(range))
            .map(|bytes| StructMemoryMut { bytes })
            .ok_or_else(outside)
    }

    /// Writes the bytes of a value.
    pub(super) fn write(&mut self, offset: usize, value: &[u8]) -> Result<(), CallError> {
        let part = self.part(offset, value.len())?;
        for (to, from) in part.bytes.iter_mut().zip(value) {
            to.write(*from);
        }
        Ok(())
    }
}

/// Length of the caller's struct in bytes. A type without fields reads and writes nothing: its value may be
/// NULL.
fn length(layout: &Layout) -> Result<usize, CallError> {
    match (layout.fields_count, isize::try_from(layout.size)) {
        (0, _) => Ok(0),
        (_, Ok(_)) => Ok(layout.size),
        (_, Err(_)) => Err(CallError::argument("the `size` of a layout is no struct's")),
    }
}

fn no_value() -> CallError {
    CallError::argument("`value` is NULL, which is legal for a type without fields alone")
}

fn range(offset: usize, size: usize) -> Option<std::ops::Range<usize>> {
    Some(offset..offset.checked_add(size)?)
}

fn outside() -> CallError {
    CallError::argument("a field lies outside of its struct: check its `offset` and the `size` of the layout")
}
