//! A struct of the caller's: read and written at checked offsets alone.

use std::{ffi::c_void, ptr};

use super::Layout;
use crate::status::Fault;

/// A struct that is read.
#[derive(Clone, Copy)]
pub(super) struct StructMemory<'call> {
    bytes: &'call [MaybePadding],
}

/// A byte of a struct, which may be padding that was never written.
type MaybePadding = std::mem::MaybeUninit<u8>;

/// A struct that is written.
pub(super) struct StructMemoryMut<'call> {
    bytes: &'call mut [MaybePadding],
}

impl StructMemory<'_> {
    pub(super) fn new(value: *const c_void, layout: &Layout) -> Result<Self, Fault> {
        check(value, layout)?;
        // SAFETY: not NULL, and the header asks of the caller that a struct of the type's length is there while the call lasts.
        let bytes = unsafe { std::slice::from_raw_parts(value.cast::<MaybePadding>(), layout.size) };
        Ok(Self { bytes })
    }

    /// The part of a nested struct.
    pub(super) fn part(self, offset: usize, size: usize) -> Result<Self, Fault> {
        range(offset, size)
            .and_then(|range| self.bytes.get(range))
            .map(|bytes| Self { bytes })
            .ok_or_else(outside)
    }

    /// The bytes of a value.
    pub(super) fn read<const N: usize>(self, offset: usize) -> Result<[u8; N], Fault> {
        let part = self.part(offset, N)?;
        // SAFETY: so many bytes are there. The header asks of the caller that the fields of a table have been written.
        Ok(unsafe { ptr::read_unaligned(part.bytes.as_ptr().cast::<[u8; N]>()) })
    }

    /// The bytes of a text or of an array of bytes.
    pub(super) fn bytes(&self, offset: usize, size: usize) -> Result<&[u8], Fault> {
        let part = self.part(offset, size)?;
        // SAFETY: so many bytes are there. The header asks of the caller that the fields of a table have been written.
        Ok(unsafe { std::slice::from_raw_parts(part.bytes.as_ptr().cast::<u8>(), size) })
    }
}

impl StructMemoryMut<'_> {
    pub(super) fn new(value: *mut c_void, layout: &Layout) -> Result<Self, Fault> {
        check(value, layout)?;
        // SAFETY: not NULL, and the header asks of the caller that a struct of the type's length is there, for this call alone.
        let bytes = unsafe { std::slice::from_raw_parts_mut(value.cast::<MaybePadding>(), layout.size) };
        Ok(Self { bytes })
    }

    /// The part of a nested struct.
    pub(super) fn part(&mut self, offset: usize, size: usize) -> Result<StructMemoryMut<'_>, Fault> {
        range(offset, size)
            .and_then(|range| self.bytes.get_mut(range))
            .map(|bytes| StructMemoryMut { bytes })
            .ok_or_else(outside)
    }

    /// Writes the bytes of a value.
    pub(super) fn write(&mut self, offset: usize, value: &[u8]) -> Result<(), Fault> {
        let part = self.part(offset, value.len())?;
        for (to, from) in part.bytes.iter_mut().zip(value) {
            to.write(*from);
        }
        Ok(())
    }
}

fn check(value: *const c_void, layout: &Layout) -> Result<(), Fault> {
    match (value.is_null(), isize::try_from(layout.size)) {
        (true, _) => Err(Fault::argument("`value` is NULL")),
        (_, Err(_)) => Err(Fault::argument("the `size` of a layout is no struct's")),
        (false, Ok(_)) => Ok(()),
    }
}

fn range(offset: usize, size: usize) -> Option<std::ops::Range<usize>> {
    Some(offset..offset.checked_add(size)?)
}

fn outside() -> Fault {
    Fault::argument("a field lies outside of its struct: check its `offset` and the `size` of the layout")
}
