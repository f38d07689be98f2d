//! Reasons of rejections, as they travel.

use sinew_runtime::outcome::{Outcome, Rejection};

/// Returns the reason with this code. An unknown code of a later version becomes `Unsupported`.
pub fn reason_of(code: u8) -> Rejection {
    match Outcome::from_code(code) {
        Some(Outcome::Rejected(why)) => why,
        Some(_) | None => Rejection::Unsupported,
    }
}

/// Returns whether the reason is the end or restart of an application. An ordinary stop causes such rejections, too, so
/// they are no warnings.
pub const fn is_of_an_end(why: Rejection) -> bool {
    matches!(why, Rejection::Closed | Rejection::Down)
}
