//! Whether somebody meddles with central's word, by what its guard has counted.

use sinew::protection::Tally;

/// Good words after which a wrong one is forgotten: as many as the guard's own memory is long.
const GOOD_STRETCH: u64 = 64;

/// Words that were damaged, are not central's, or came twice or out of their order, since the last good stretch; whatever the guard was shut for.
/// No network does that to what Sinew carries: late and lost are another thing. They are forgotten
/// through an open guard only: one that falls silent while it is shut has not become trustworthy by that.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Suspicion {
    /// Wrong words that are known of.
    wrong: u64,
    /// Good words until the last one of them; `None` when they are forgotten.
    good: Option<u64>,
}

impl Suspicion {
    /// Takes in what the guard has counted until now.
    pub(super) fn note(&mut self, tally: &Tally, is_open: bool) {
        let wrong = tally.corrupt + tally.repeated + tally.backwards;
        if wrong > self.wrong {
            (self.wrong, self.good) = (wrong, Some(tally.good));
        } else if is_open && self.good.is_some_and(|good| tally.good - good >= GOOD_STRETCH) {
            self.good = None;
        }
    }

    /// Somebody who knew of them has let the word count again.
    pub(super) const fn forget(&mut self) {
        self.good = None;
    }

    /// Whether there are any.
    pub(super) const fn is_there(&self) -> bool {
        self.good.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_word_that_comes_twice_or_out_of_its_order_is_as_wrong_as_a_damaged_one() {
        for wrong in [Tally { repeated: 1, ..Tally::default() }, Tally { backwards: 1, ..Tally::default() }] {
            let mut suspicion = Suspicion::default();
            suspicion.note(&wrong, true);
            assert!(suspicion.is_there(), "{wrong:?}");
        }
        let mut suspicion = Suspicion::default();
        suspicion.note(&Tally { too_old: 9, restarted: 1, gaps: 3, lost: 3, ..Tally::default() }, true);
        assert!(!suspicion.is_there(), "late, lost and anew are what networks and nodes do");
    }

    fn after(words: &[(u64, u64, bool)]) -> bool {
        let mut suspicion = Suspicion::default();
        for &(good, corrupt, is_open) in words {
            suspicion.note(&Tally { good, corrupt, ..Tally::default() }, is_open);
        }
        suspicion.is_there()
    }

    #[test]
    fn damaged_words_that_come_after_a_silence_are_suspect_however_many_good_ones_follow_them() {
        assert!(!after(&[(100, 0, true), (100, 0, false)]), "silence alone is not");
        assert!(after(&[(100, 0, true), (100, 0, false), (100, 3, false)]));
        assert!(after(&[(100, 0, true), (100, 3, false), (1_000, 3, false)]), "it is shut all the while");
    }

    #[test]
    fn damaged_word_that_was_borne_long_ago_is_forgotten() {
        let borne = [(100, 1, true), (100 + GOOD_STRETCH - 1, 1, true)];
        assert!(after(&borne));
        assert!(!after(&[borne[0], (100 + GOOD_STRETCH, 1, true), (100 + GOOD_STRETCH, 1, false)]));
    }

    #[test]
    fn damaged_word_after_it_was_armed_is_suspect_anew() {
        let mut suspicion = Suspicion::default();
        let tally = |corrupt| Tally { good: 100, corrupt, ..Tally::default() };
        suspicion.note(&tally(2), false);
        suspicion.forget();
        suspicion.note(&tally(2), true);
        assert!(!suspicion.is_there());
        suspicion.note(&tally(3), false);
        assert!(suspicion.is_there());
    }
}
