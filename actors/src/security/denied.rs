//! The deny list: numbers of certificates that no longer count, whatever their times.
//!
//! ```text
//! # Certificates that are revoked, one number a line.
//! 2d6f6e1a90c3  # hip 192.168.0.11, revoked 2026-11-22T15:13:00Z
//! ```
//!
//! It is a file beside the keys, made by `sinew keys revoke`, and as good as the file's own protection: who can write it on a node
//! has that node anyway. A file that is not there is a fault, not an empty list.

use std::collections::BTreeSet;

use super::Serial;

/// Numbers of certificates that are revoked.
///
/// # Examples
///
/// ```
/// use sinew::security::DenyList;
///
/// // The knee's controller was stolen: the number of its certificate is on the list.
/// let denied = DenyList::read("2d6f  # knee, stolen in May\n")?;
/// assert_eq!(denied.len(), 1);
/// # Ok::<(), sinew::security::DenyListFault>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DenyList(BTreeSet<Serial>);

/// A line that is no number: nothing of the list is taken, since what it meant to deny would count.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DenyListFault {
    /// A line cannot be read.
    #[error(
        "line {line} is {found:?}; write a certificate's number in hexadecimal digits, or a comment after `#`"
    )]
    Line {
        /// Which, from 1.
        line: usize,
        /// Its beginning.
        found: String,
    },
    /// There are too many.
    #[error(
        "there are more than {} numbers; take out those of certificates that have ended (`sinew keys show`)",
        DenyList::SERIALS_MAX
    )]
    TooLong,
}

impl DenyList {
    /// Numbers at most.
    pub const SERIALS_MAX: usize = 65_536;

    /// Reads the list in `text`.
    ///
    /// # Errors
    /// The first line that is none.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::security::DenyList;
    /// let denied = DenyList::read("# none yet\n\n2d6f  # hip\n").unwrap();
    /// assert!(denied.has(&"2D6F".parse().unwrap()));
    /// assert!(DenyList::read("2d6f hip").is_err());
    /// ```
    pub fn read(text: &str) -> Result<Self, DenyListFault> {
        const SHOWN_MAX: usize = 40;
        let mut serials = BTreeSet::new();
        for (at, line) in text.lines().enumerate() {
            let number = line.split('#').next().unwrap_or_default().trim();
            if number.is_empty() {
                continue;
            }
            let shown = || line.chars().take(SHOWN_MAX).collect();
            let serial = number.parse().map_err(|()| DenyListFault::Line { line: at + 1, found: shown() })?;
            serials.insert(serial);
            if serials.len() > Self::SERIALS_MAX {
                return Err(DenyListFault::TooLong);
            }
        }
        Ok(Self(serials))
    }

    /// Whether the certificate of this number is revoked.
    #[must_use]
    pub fn has(&self, serial: &Serial) -> bool {
        self.0.contains(serial)
    }

    /// How many of these are not on the list `later`.
    #[must_use]
    pub fn not_on(&self, later: &Self) -> usize {
        self.0.difference(&later.0).count()
    }

    /// How many are revoked.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether none is.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_that_is_no_number_is_told_and_nothing_is_taken() {
        for (text, line) in [("zz", 1), ("2d6f\n\n2d6\n", 3), ("2d6f, 2d70", 1), ("00", 1), ("+1", 1)] {
            let fault = DenyList::read(text).unwrap_err();
            assert!(matches!(fault, DenyListFault::Line { line: found, .. } if found == line), "{fault}");
        }
        assert!(DenyList::read(&"ab".repeat(21)).is_err(), "no certificate has such a number");
    }

    #[test]
    fn a_number_is_the_same_in_any_writing() {
        let denied = DenyList::read("00AB12#hip\r\n").unwrap();
        assert!(denied.has(&Serial::new(&[0xab, 0x12]).unwrap()) && denied.len() == 1);
    }

    #[test]
    fn the_list_is_bounded() {
        let lines = |count: usize| (1..=count).map(|serial| format!("{serial:08x}\n")).collect::<String>();
        assert_eq!(DenyList::read(&lines(DenyList::SERIALS_MAX)).unwrap().len(), DenyList::SERIALS_MAX);
        assert_eq!(DenyList::read(&lines(DenyList::SERIALS_MAX + 1)), Err(DenyListFault::TooLong));
    }
}
