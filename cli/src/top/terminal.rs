//! The screen of `sinew top`: a thread asks the nodes, this one draws and reads keys.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, SyncSender, TryRecvError, sync_channel},
    },
    time::{Duration, Instant},
};

use ratatui::{
    DefaultTerminal, Frame,
    crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers},
    layout::{Constraint, Layout},
    style::{Color, Modifier, Style},
    text::{Line as Styled, Span},
    widgets::Paragraph,
};
use sinew_view::{Snapshot, Source as _};
use unicode_width::UnicodeWidthStr as _;

use super::{
    controls::{Controls, Extent, Key},
    lines::{Line, Role, lines},
    model::Model,
};
use crate::{record::stop::StopRequest, table::clean, view::Nodes};

/// Interval between two snapshots.
const PERIOD: Duration = Duration::from_millis(500);
/// Longest wait for a key before the next snapshot is looked for.
const KEYS_WITHIN: Duration = Duration::from_millis(50);
/// Maximum number of keys before the next drawing.
const KEYS_MAX: usize = 64;
/// Lines of the screen beside the tables: the first and the last one.
const OWN_LINES: u16 = 2;

/// Shows the system until the user ends it.
///
/// # Errors
/// The terminal cannot be set up, drawn on or read, or the system gives no thread.
pub(super) fn run(nodes: Nodes, first: Snapshot) -> io::Result<()> {
    let stop = StopRequest::listen_on_terminal()?;
    let is_paused = Arc::new(AtomicBool::new(false));
    let (put, snapshots) = sync_channel(1);
    let (path, paused) = (nodes.path(), is_paused.clone());
    // It ends with the process, where no snapshot is wanted.
    std::thread::Builder::new().name("snapshots".to_owned()).spawn(move || sample(&nodes, &put, &paused))?;
    // A part of it may have been done.
    let mut terminal = ratatui::try_init().inspect_err(|_| _ = ratatui::try_restore())?;
    let model = Model::of(None, &first);
    let screen = Screen { path, model, last: first, controls: Controls::default(), is_paused };
    let end = screen.show(&mut terminal, &snapshots, &stop);
    let restored = ratatui::try_restore();
    end.and(restored)
}

/// Takes snapshots until the screen has ended. A slow one delays the next, and none is taken while it is paused.
fn sample(nodes: &Nodes, snapshots: &SyncSender<Snapshot>, is_paused: &AtomicBool) {
    loop {
        let due = Instant::now() + PERIOD;
        if !is_paused.load(Ordering::Relaxed) && snapshots.send(nodes.snapshot()).is_err() {
            return;
        }
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
}

struct Screen {
    path: String,
    model: Model,
    last: Snapshot,
    controls: Controls,
    is_paused: Arc<AtomicBool>,
}

impl Screen {
    fn show(
        mut self,
        terminal: &mut DefaultTerminal,
        snapshots: &Receiver<Snapshot>,
        stop: &StopRequest,
    ) -> io::Result<()> {
        let mut extent = self.draw(terminal)?;
        while !self.controls.is_over && !stop.is_there() {
            let has_new = self.take(snapshots)?;
            if self.read_keys(extent)? || has_new {
                extent = self.draw(terminal)?;
            }
        }
        Ok(())
    }

    /// Takes the next snapshot. Returns whether there is one to be shown.
    fn take(&mut self, snapshots: &Receiver<Snapshot>) -> io::Result<bool> {
        match snapshots.try_recv() {
            // One that was under way when the screen was paused is not shown.
            Ok(next) if !self.controls.is_paused => {
                self.model = Model::of(Some(&self.last), &next);
                self.last = next;
                Ok(true)
            }
            Ok(_) | Err(TryRecvError::Empty) => Ok(false),
            Err(TryRecvError::Disconnected) => {
                Err(io::Error::other("the thread that asks the nodes has panicked; report it, please"))
            }
        }
    }

    /// Handles the keys that wait. Returns whether the screen may have changed, also in its size.
    fn read_keys(&mut self, extent: Extent) -> io::Result<bool> {
        let mut has_any = false;
        for _ in 0..KEYS_MAX {
            if !event::poll(if has_any { Duration::ZERO } else { KEYS_WITHIN })? {
                break;
            }
            has_any = true;
            let event = event::read()?;
            if let Event::Key(pressed) = event
                && let Some(key) = key(pressed)
            {
                self.controls.press(key, extent);
            }
            // The next key counts on a screen of the new size.
            if matches!(event, Event::Resize(..)) {
                break;
            }
        }
        self.is_paused.store(self.controls.is_paused, Ordering::Relaxed);
        Ok(has_any)
    }

    fn draw(&self, terminal: &mut DefaultTerminal) -> io::Result<Extent> {
        let shown = lines(&self.model, &self.controls.filter);
        let size = terminal.size()?;
        let extent = Extent {
            lines: shown.len(),
            visible: size.height.saturating_sub(OWN_LINES).into(),
            columns: shown.iter().map(|line| line.text.width()).max().unwrap_or(0),
            width: size.width.into(),
        };
        terminal.draw(|frame| self.render(frame, &shown, extent))?;
        Ok(extent)
    }

    fn render(&self, frame: &mut Frame<'_>, shown: &[Line], extent: Extent) {
        let rows = [Constraint::Length(1), Constraint::Min(0), Constraint::Length(1)];
        let [head, body, foot] = Layout::vertical(rows).areas(frame.area());
        frame.render_widget(Paragraph::new(self.head()), head);
        let visible = shown.iter().skip(self.controls.scroll(extent)).take(extent.visible);
        let left = u16::try_from(self.controls.left(extent)).unwrap_or(u16::MAX);
        let tables = Paragraph::new(visible.map(styled).collect::<Vec<_>>()).scroll((0, left));
        frame.render_widget(tables, body);
        frame.render_widget(Paragraph::new(self.foot()), foot);
    }

    /// Returns the first line, its most important parts first: a narrow terminal cuts the others off.
    fn head(&self) -> Styled<'static> {
        let mut spans = vec![Span::styled("sinew top", Modifier::BOLD)];
        if self.controls.is_paused {
            spans.push(Span::styled("  PAUSED", Modifier::REVERSED));
        }
        if let Some(why) = &self.model.fault {
            spans.push(Span::styled(format!("  its node does not answer: {}", clean(why)), Color::Red));
        }
        if self.model.left_out > 0 {
            spans.push(Span::raw(format!("  {} further nodes", self.model.left_out)));
        }
        spans.push(Span::raw(format!("  through {}", clean(&self.path))));
        Styled::from(spans)
    }

    fn foot(&self) -> Styled<'static> {
        let Controls { filter, is_typing, .. } = &self.controls;
        if *is_typing {
            return Styled::from(format!("/{filter}_   Enter keeps it, Esc removes it"));
        }
        let filter = if filter.is_empty() {
            String::new()
        } else {
            format!("   only rows with `{filter}`, Esc shows all")
        };
        Styled::from(format!("q end   / filter   p pause   arrows, PgUp, PgDn scroll{filter}"))
    }
}

fn styled(line: &Line) -> Styled<'_> {
    let style = match line.role {
        Role::Title => Style::new().add_modifier(Modifier::BOLD),
        Role::Heading => Style::new().add_modifier(Modifier::UNDERLINED),
        Role::Finding => Style::new().fg(Color::Red),
        Role::Fine | Role::Blank => Style::new(),
    };
    Styled::styled(line.text.as_str(), style)
}

/// Returns the key, if it has a meaning.
#[expect(clippy::wildcard_enum_match_arm, reason = "a terminal has many keys, and only these do something")]
fn key(pressed: KeyEvent) -> Option<Key> {
    if pressed.kind == KeyEventKind::Release {
        return None;
    }
    let is_control = pressed.modifiers.contains(KeyModifiers::CONTROL);
    match pressed.code {
        KeyCode::Char('c') if is_control => Some(Key::Interrupt),
        KeyCode::Char(sign) if !is_control => Some(Key::Char(sign)),
        KeyCode::Up => Some(Key::Up),
        KeyCode::Down => Some(Key::Down),
        KeyCode::Left => Some(Key::Left),
        KeyCode::Right => Some(Key::Right),
        KeyCode::PageUp => Some(Key::PageUp),
        KeyCode::PageDown => Some(Key::PageDown),
        KeyCode::Home => Some(Key::Home),
        KeyCode::End => Some(Key::End),
        KeyCode::Enter => Some(Key::Enter),
        KeyCode::Esc => Some(Key::Escape),
        KeyCode::Backspace => Some(Key::Backspace),
        _ => None,
    }
}
