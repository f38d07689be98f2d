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
    let stop = StopRequest::listen()?;
    let is_paused = Arc::new(AtomicBool::new(false));
    let (put, snapshots) = sync_channel(1);
    let (path, paused) = (nodes.path(), is_paused.clone());
    // It ends with the process, where no snapshot is wanted.
    std::thread::Builder::new().name("snapshots".to_owned()).spawn(move || sample(&nodes, &put, &paused))?;
    let mut terminal = ratatui::try_init()?;
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
        while !self.controls.is_over && !stop.is_there() {
            match snapshots.try_recv() {
                // One that was under way when the screen was paused is not shown.
                Ok(next) if !self.controls.is_paused => {
                    self.model = Model::of(Some(&self.last), &next);
                    self.last = next;
                }
                Ok(_) | Err(TryRecvError::Empty) => {}
                Err(TryRecvError::Disconnected) => {
                    return Err(io::Error::other(
                        "the thread that asks the nodes has panicked; report it, please",
                    ));
                }
            }
            let shown = lines(&self.model, &self.controls.filter);
            let visible = terminal.size()?.height.saturating_sub(OWN_LINES);
            let extent = Extent { lines: shown.len(), visible: visible.into() };
            terminal.draw(|frame| self.draw(frame, &shown, extent))?;
            self.read_keys(extent)?;
        }
        Ok(())
    }

    fn read_keys(&mut self, extent: Extent) -> io::Result<()> {
        let mut within = KEYS_WITHIN;
        for _ in 0..KEYS_MAX {
            if !event::poll(within)? {
                break;
            }
            if let Event::Key(pressed) = event::read()?
                && let Some(key) = key(pressed)
            {
                self.controls.press(key, extent);
            }
            within = Duration::ZERO;
        }
        self.is_paused.store(self.controls.is_paused, Ordering::Relaxed);
        Ok(())
    }

    fn draw(&self, frame: &mut Frame<'_>, shown: &[Line], extent: Extent) {
        let rows = [Constraint::Length(1), Constraint::Min(0), Constraint::Length(1)];
        let [head, body, foot] = Layout::vertical(rows).areas(frame.area());
        frame.render_widget(Paragraph::new(self.head()), head);
        let first = self.controls.scroll(extent);
        let visible = shown.iter().skip(first).take(extent.visible);
        frame.render_widget(Paragraph::new(visible.map(styled).collect::<Vec<_>>()), body);
        frame.render_widget(Paragraph::new(self.foot()), foot);
    }

    fn head(&self) -> Styled<'static> {
        let mut spans = vec![
            Span::styled("sinew top", Modifier::BOLD),
            Span::raw(format!("  through {}", clean(&self.path))),
        ];
        if self.controls.is_paused {
            spans.push(Span::styled("  PAUSED", Modifier::REVERSED));
        }
        if self.model.left_out > 0 {
            spans.push(Span::raw(format!("  {} further nodes", self.model.left_out)));
        }
        if let Some(why) = &self.model.fault {
            spans.push(Span::styled(format!("  its node does not answer: {}", clean(why)), Color::Red));
        }
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
        Styled::from(format!("q end   arrows, PgUp, PgDn scroll   / filter   p pause{filter}"))
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
