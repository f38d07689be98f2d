//! Texts from C: a pointer, a length, and the check that they are UTF-8.

use std::{
    ffi::{OsStr, c_char},
    os::unix::ffi::OsStrExt,
    path::Path,
    slice,
};

use crate::status::CallError;

/// Maximum length of a text in bytes: no name and no path is longer.
const LENGTH_MAX: usize = 4096;
/// Maximum number of texts in a list.
const COUNT_MAX: usize = 64;

/// A text: UTF-8, not terminated by a zero. `SINEW_TEXT("...")` makes one of a literal, `sinew_text_of` of a
/// C string.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Text {
    /// The first byte; may be NULL if the length is 0.
    pub bytes: *const c_char,
    /// Length in bytes, without a zero at its end.
    pub length: usize,
}

impl Text {
    /// Returns the text, which C keeps in place during the call.
    pub(crate) fn read(&self, name: &str) -> Result<&str, CallError> {
        std::str::from_utf8(self.bytes(name)?)
            .map_err(|error| CallError::argument(format!("`{name}` is no UTF-8: {error}")))
    }

    /// As [`Self::read`], for a path, which may have any bytes but zeros.
    pub(crate) fn path(&self, name: &str) -> Result<&Path, CallError> {
        Ok(Path::new(OsStr::from_bytes(self.bytes(name)?)))
    }

    fn bytes(&self, name: &str) -> Result<&[u8], CallError> {
        if self.length > LENGTH_MAX {
            return Err(CallError::argument(format!(
                "`{name}` has {} bytes; at most {LENGTH_MAX} are looked at",
                self.length
            )));
        }
        // SAFETY: the header requires that these bytes are valid during the call; the length was checked.
        unsafe { memory(self.bytes.cast(), self.length) }
            .ok_or_else(|| CallError::argument(format!("`{name}` is NULL, but has a length")))
    }
}

/// Returns the texts of a list, which C keeps in place during the call.
pub(crate) fn read_all(first: *const Text, count: usize, name: &str) -> Result<Vec<&str>, CallError> {
    if count > COUNT_MAX {
        return Err(CallError::argument(format!(
            "`{name}` has {count} texts; at most {COUNT_MAX} are legal"
        )));
    }
    // SAFETY: the header requires that `count` texts are valid during the call; the count was checked.
    let texts = unsafe { memory(first, count) };
    let texts = texts.ok_or_else(|| CallError::argument(format!("`{name}` is NULL, but has a count")))?;
    texts.iter().map(|text| text.read(name)).collect()
}

/// Memory of the caller. An empty slice may begin at NULL; otherwise NULL gives `None`.
///
/// # Safety
/// `count` values of `T` are valid and do not change while the result is used, unless `first` is NULL;
/// together they have at most `isize::MAX` bytes.
pub(crate) unsafe fn memory<'call, T>(first: *const T, count: usize) -> Option<&'call [T]> {
    match (first.is_null(), count) {
        (_, 0) => Some(&[]),
        (true, _) => None,
        // SAFETY: not NULL, and the caller of this function vouches for the rest.
        (false, _) => Some(unsafe { slice::from_raw_parts(first, count) }),
    }
}

/// Memory of the caller, to write. `None` if it begins at NULL and is not empty.
///
/// # Safety
/// `count` values of `T` are valid, for the user of the result only, unless `first` is NULL; together they
/// have at most `isize::MAX` bytes, and any bytes are a `T`.
pub(crate) unsafe fn memory_mut<'call, T>(first: *mut T, count: usize) -> Option<&'call mut [T]> {
    match (first.is_null(), count) {
        (_, 0) => Some(&mut []),
        (true, _) => None,
        // SAFETY: not NULL, and the caller of this function vouches for the rest.
        (false, _) => Some(unsafe { slice::from_raw_parts_mut(first, count) }),
    }
}

#[cfg(test)]
mod tests {
    use std::ptr;

    use super::*;

    const fn text(bytes: &[u8]) -> Text {
        Text { bytes: bytes.as_ptr().cast(), length: bytes.len() }
    }

    #[test]
    fn text_is_utf8_or_an_error_with_its_name() {
        assert_eq!(text("Knöchel".as_bytes()).read("name"), Ok("Knöchel"));
        assert_eq!(Text { bytes: ptr::null(), length: 0 }.read("name"), Ok(""));
        let wrong = [text(b"\xff"), Text { bytes: ptr::null(), length: 3 }, text(&[b'a'; LENGTH_MAX + 1])];
        for text in wrong {
            let error = format!("{:?}", text.read("name").unwrap_err());
            assert!(error.contains("`name`"), "{error}");
        }
    }

    #[test]
    fn list_of_texts_is_bounded() {
        let names = [text(b"hip"), text(b"knee")];
        assert_eq!(read_all(names.as_ptr(), 2, "required"), Ok(vec!["hip", "knee"]));
        assert_eq!(read_all(ptr::null(), 0, "required"), Ok(Vec::new()));
        assert!(read_all(ptr::null(), 1, "required").is_err());
        assert!(read_all(names.as_ptr(), usize::MAX, "required").is_err());
    }
}
