//! The deny list: serial numbers of revoked certificates, regardless of their validity periods.
//!
//! ```text
//! # Certificates that are revoked, one number a line.
//! 2d6f6e1a90c3  # hip 192.168.0.11, revoked 2026-11-22T15:13:00Z
//! ```
//!
//! The list is a file beside the keys, made by `sinew keys revoke`. It is as trustworthy as the file's own
//! protection: a user with write access to it on a node controls that node anyway. A missing file is a fault,
//! not an empty list.

use std::collections::BTreeSet;

use super::Serial;

/// Serial numbers of revoked certificates.
///
/// # Examples
///
/// ```
/// use sinew::security::DenyList;
///
/// // The knee's controller was stolen: the number of its certificate is on the list.
/// let denied = DenyList::read("2d6f  # knee, stolen in May\n")?;
/// assert_eq!(denied.len(), 1);
/// # Ok::<(), sinew::security::DenyListEntryError>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DenyList(BTreeSet<Serial>);

/// A deny list that cannot be read. No entry of it is used, since a certificate that it meant to deny would
/// be accepted.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DenyListEntryError {
    /// A line cannot be parsed.
    #[error(
        "line {line} is {found:?}; write a certificate's number in hexadecimal digits, or a comment after `#`"
    )]
    Line {
        /// Line number, from 1.
        line: usize,
        /// Start of the line.
        found: String,
    },
    /// The list has too many numbers.
    #[error(
        "there are more than {} numbers; take out those of certificates that have ended (`sinew keys show`)",
        DenyList::SERIALS_MAX
    )]
    TooLong,
}

impl DenyList {
    /// Maximum number of serial numbers.
    pub const SERIALS_MAX: usize = 65_536;

    /// Parses the list in `text`.
    ///
    /// # Errors
    /// Returns the first line that cannot be parsed.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::security::DenyList;
    /// let denied = DenyList::read("# none yet\n\n2d6f  # hip\n").unwrap();
    /// assert!(denied.has(&"2D6F".parse().unwrap()));
    /// assert!(DenyList::read("2d6f hip").is_err());
    /// ```
    pub fn read(text: &str) -> Result<Self, DenyListEntryError> {
        const SHOWN_MAX: usize = 40;
        let mut serials = BTreeSet::new();
        for (at, line) in text.lines().enumerate() {
            let number = line.split('#').next().unwrap_or_default().trim();
            if number.is_empty() {
                continue;
            }
            let shown = || line.chars().take(SHOWN_MAX).collect();
            let serial =
                number.parse().map_err(|()| DenyListEntryError::Line { line: at + 1, found: shown() })?;
            serials.insert(serial);
            if serials.len() > Self::SERIALS_MAX {
                return Err(DenyListEntryError::TooLong);
            }
        }
        Ok(Self(serials))
    }

    /// Returns whether the certificate with this serial number is revoked.
    #[must_use]
    pub fn has(&self, serial: &Serial) -> bool {
        self.0.contains(serial)
    }

    /// Returns how many of these numbers are missing from the list `later`.
    #[must_use]
    pub fn not_on(&self, later: &Self) -> usize {
        self.0.difference(&later.0).count()
    }

    /// Returns the number of revoked certificates.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Returns whether the list is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_line_is_reported_and_list_is_refused() {
        for (text, line) in [("zz", 1), ("2d6f\n\n2d6\n", 3), ("2d6f, 2d70", 1), ("00", 1), ("+1", 1)] {
            let fault = DenyList::read(text).unwrap_err();
            assert!(
                matches!(fault, DenyListEntryError::Line { line: found, .. } if found == line),
                "{fault}"
            );
        }
        assert!(DenyList::read(&"ab".repeat(21)).is_err(), "no certificate has such a number");
    }

    #[test]
    fn number_spellings_are_equal() {
        let denied = DenyList::read("00AB12#hip\r\n").unwrap();
        assert!(denied.has(&Serial::new(&[0xab, 0x12]).unwrap()) && denied.len() == 1);
    }

    #[test]
    fn the_list_is_bounded() {
        let lines = |count: usize| (1..=count).map(|serial| format!("{serial:08x}\n")).collect::<String>();
        assert_eq!(DenyList::read(&lines(DenyList::SERIALS_MAX)).unwrap().len(), DenyList::SERIALS_MAX);
        assert_eq!(DenyList::read(&lines(DenyList::SERIALS_MAX + 1)), Err(DenyListEntryError::TooLong));
    }
}
