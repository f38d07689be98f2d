//! Writes down what was sent and got: rows of numbers, not each one.

use std::{
    collections::BTreeMap,
    io::Write,
    sync::{Arc, Mutex, PoisonError},
};

use sinew::Class;

use crate::history::{Note, Party, Station};

/// What one party writes down. Clones write in the same book.
#[derive(Clone, Debug, Default)]
pub(super) struct Clerk(Arc<Mutex<Book>>);

/// A row that may go on.
#[derive(Clone, Copy, Debug)]
struct Row {
    first: u64,
    count: u64,
}

/// What the numbers of a row have in common.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Column {
    Sent { to: Station, class: Class, asked: bool },
    Got { from: Party, class: Class },
}

#[derive(Debug, Default)]
struct Book {
    rows: BTreeMap<Column, Row>,
    text: String,
}

impl Clerk {
    /// This message was sent.
    pub(super) fn sent(&self, to: Station, class: Class, number: u64, asked: bool) {
        let other = Column::Sent { to, class, asked: !asked };
        self.with(|book| {
            // What is read is in the order of the numbers.
            book.close(other);
            book.add(Column::Sent { to, class, asked }, number);
        });
    }

    /// This message was got. If its sender waits, everything is said at once.
    pub(super) fn got(&self, from: Party, class: Class, number: u64, is_awaited: bool) {
        self.with(|book| {
            book.add(Column::Got { from, class }, number);
            if is_awaited {
                book.say();
            }
        });
    }

    /// This happened, after all that was written down before.
    pub(super) fn note(&self, note: Note) {
        self.with(|book| {
            book.close_all();
            book.write(&note);
        });
    }

    /// Says everything now.
    pub(super) fn say(&self) {
        self.with(Book::say);
    }

    fn with(&self, act: impl FnOnce(&mut Book)) {
        act(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

impl Book {
    fn add(&mut self, column: Column, number: u64) {
        match self.rows.get_mut(&column) {
            Some(row) if row.first + row.count == number => row.count += 1,
            Some(_) | None => {
                self.close(column);
                self.rows.insert(column, Row { first: number, count: 1 });
            }
        }
    }

    fn close(&mut self, column: Column) {
        let Some(Row { first, count }) = self.rows.remove(&column) else { return };
        self.write(&match column {
            Column::Sent { to, class, asked } => Note::Sent { to, class, first, count, asked },
            Column::Got { from, class } => Note::Got { from, class, first, count },
        });
    }

    fn write(&mut self, note: &Note) {
        self.text.push_str(&note.to_string());
        self.text.push('\n');
    }

    fn close_all(&mut self) {
        let columns: Vec<Column> = self.rows.keys().copied().collect();
        columns.into_iter().for_each(|column| self.close(column));
    }

    /// In whole lines, and before whoever waits for it goes on: a killed process has said what it has said.
    fn say(&mut self) {
        self.close_all();
        let mut out = std::io::stdout().lock();
        // Nobody listens: the director is gone, and this process soon too.
        let _ = out.write_all(self.text.as_bytes()).and_then(|()| out.flush());
        self.text.clear();
    }
}
