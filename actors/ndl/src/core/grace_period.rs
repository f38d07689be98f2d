//! A grace period, after which silent members are lost. The local timer was late, so answers may still be
//! unread in the socket.

use std::time::Duration;

use sinew_runtime::time::Time;

/// Maximum number of consecutive cycles that count no loss, and of consecutive grace periods of one silence.
/// A timer that is always late cannot postpone losses forever.
pub(super) const IN_A_ROW_MAX: u32 = 3;

/// A grace period of the members at one pace.
#[derive(Clone, Copy, Debug)]
pub(super) struct GracePeriod {
    pub(super) until: Time,
    lasts: Duration,
    /// Number of consecutive grace periods of one silence.
    pub(super) in_a_row: u32,
}

impl GracePeriod {
    /// Returns the grace period after a timer that was `late`, if one is due. Half a `period` is the longest.
    ///
    /// The `former` one is renewed if its end came later than twice the delay that caused it, up to
    /// [`IN_A_ROW_MAX`] times in a row. // spec: NDL-4.2
    pub(super) fn after(now: Time, late: Duration, period: Duration, former: Option<Self>) -> Option<Self> {
        let (allowed, in_a_row) =
            former.map_or((Duration::ZERO, 0), |former| (former.lasts * 2, former.in_a_row));
        if late <= allowed || in_a_row >= IN_A_ROW_MAX {
            return None;
        }
        let lasts = late.min(period / 2);
        Some(Self { until: now + lasts, lasts, in_a_row: in_a_row + 1 })
    }
}
