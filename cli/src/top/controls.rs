//! The keys of `sinew top`, and their effects. Pure.

/// Maximum length of a filter, in characters.
const FILTER_MAX: usize = 64;
/// Columns by which one key moves the tables sideways.
const STEP: usize = 8;

/// A key that has a meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Key {
    Char(char),
    Up,
    Down,
    Left,
    Right,
    PageUp,
    PageDown,
    Home,
    End,
    Enter,
    Escape,
    Backspace,
    /// Ctrl-C.
    Interrupt,
}

/// The state that the keys change.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Controls {
    pub(super) filter: String,
    /// Whether characters belong to the filter.
    pub(super) is_typing: bool,
    pub(super) is_paused: bool,
    pub(super) is_over: bool,
    /// The first visible line.
    scroll: usize,
    /// The first visible column.
    left: usize,
}

/// The size of the tables, and how much of it is visible.
#[derive(Clone, Copy, Debug)]
pub(super) struct Extent {
    pub(super) lines: usize,
    pub(super) visible: usize,
    /// Columns of the longest line.
    pub(super) columns: usize,
    /// Columns of the terminal.
    pub(super) width: usize,
}

impl Extent {
    const fn scroll_max(self) -> usize {
        self.lines.saturating_sub(self.visible)
    }
}

impl Controls {
    pub(super) fn press(&mut self, key: Key, extent: Extent) {
        match key {
            Key::Interrupt => self.is_over = true,
            Key::Up => self.scroll = self.scroll(extent).saturating_sub(1),
            Key::Down => self.scroll += 1,
            Key::Left => self.left = self.left(extent).saturating_sub(STEP),
            Key::Right => self.left += STEP,
            Key::PageUp => self.scroll = self.scroll(extent).saturating_sub(extent.visible),
            Key::PageDown => self.scroll += extent.visible,
            Key::Home => self.scroll = 0,
            Key::End => self.scroll = extent.scroll_max(),
            Key::Char(sign) if self.is_typing => self.type_sign(sign),
            Key::Backspace if self.is_typing => _ = self.filter.pop(),
            Key::Enter => self.is_typing = false,
            Key::Escape => (self.is_typing, self.filter) = (false, String::new()),
            Key::Char('q') => self.is_over = true,
            Key::Char('p') => self.is_paused = !self.is_paused,
            Key::Char('/') => (self.is_typing, self.filter) = (true, String::new()),
            Key::Char(_) | Key::Backspace => {}
        }
        (self.scroll, self.left) = (self.scroll(extent), self.left(extent));
    }

    /// Returns the first visible line: the tables may have become shorter.
    pub(super) fn scroll(&self, extent: Extent) -> usize {
        self.scroll.min(extent.scroll_max())
    }

    /// Returns the first visible column: the tables may have become narrower.
    pub(super) fn left(&self, extent: Extent) -> usize {
        self.left.min(extent.columns.saturating_sub(extent.width))
    }

    fn type_sign(&mut self, sign: char) {
        if !sign.is_control() && self.filter.chars().count() < FILTER_MAX {
            self.filter.push(sign);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXTENT: Extent = Extent { lines: 30, visible: 10, columns: 100, width: 80 };

    fn pressed(keys: &[Key]) -> Controls {
        let mut controls = Controls::default();
        keys.iter().for_each(|key| controls.press(*key, EXTENT));
        controls
    }

    #[test]
    fn q_and_interrupt_end_it() {
        assert!(pressed(&[Key::Char('q')]).is_over && pressed(&[Key::Interrupt]).is_over);
        assert!(pressed(&[Key::Char('/'), Key::Interrupt]).is_over);
        assert!(!pressed(&[Key::Char('x'), Key::Enter]).is_over);
    }

    #[test]
    fn scroll_stays_within_the_tables() {
        assert_eq!(pressed(&[Key::Up]).scroll(EXTENT), 0);
        assert_eq!(pressed(&[Key::Down, Key::Down, Key::Up]).scroll(EXTENT), 1);
        assert_eq!(pressed(&[Key::PageDown]).scroll(EXTENT), 10);
        assert_eq!(pressed(&[Key::PageDown; 5]).scroll(EXTENT), 20);
        assert_eq!(pressed(&[Key::End, Key::PageUp]).scroll(EXTENT), 10);
        assert_eq!(pressed(&[Key::End, Key::Home]).scroll(EXTENT), 0);
        // When: the tables become shorter
        assert_eq!(pressed(&[Key::End]).scroll(Extent { lines: 12, ..EXTENT }), 2);
        assert_eq!(pressed(&[Key::End]).scroll(Extent { lines: 3, ..EXTENT }), 0);
    }

    #[test]
    fn narrow_terminal_shows_all_columns_in_turn() {
        assert_eq!(pressed(&[Key::Left]).left(EXTENT), 0);
        assert_eq!(pressed(&[Key::Right, Key::Right, Key::Left]).left(EXTENT), STEP);
        // The last column is at the right edge.
        assert_eq!(pressed(&[Key::Right; 5]).left(EXTENT), 20);
        // When: the terminal becomes wide enough
        assert_eq!(pressed(&[Key::Right]).left(Extent { width: 120, ..EXTENT }), 0);
    }

    #[test]
    fn filter_takes_all_characters_until_enter() {
        let typed =
            pressed(&[Key::Char('/'), Key::Char('q'), Key::Char('p'), Key::Char('x'), Key::Backspace]);
        assert_eq!((typed.filter.as_str(), typed.is_typing), ("qp", true));
        assert!(!typed.is_over && !typed.is_paused);
        let mut entered = typed;
        entered.press(Key::Enter, EXTENT);
        entered.press(Key::Char('p'), EXTENT);
        assert_eq!((entered.filter.as_str(), entered.is_typing, entered.is_paused), ("qp", false, true));
        entered.press(Key::Escape, EXTENT);
        assert_eq!(entered.filter, "");
    }

    #[test]
    fn filter_has_a_bound() {
        let keys: Vec<_> = [Key::Char('/')].into_iter().chain([Key::Char('ä'); 2 * FILTER_MAX]).collect();
        assert_eq!(pressed(&keys).filter.chars().count(), FILTER_MAX);
    }
}
