//! Notes sent and received messages, as ranges of numbers.

use std::{
    collections::BTreeMap,
    io::Write,
    sync::{Arc, Mutex},
};

use sinew::Class;
use sinew_runtime::lock;

use sinew_testkit::history::{Note, Party, Station};

/// The notes of one party. Clones share the same notes.
#[derive(Clone, Debug, Default)]
pub(super) struct Clerk(Arc<Mutex<Book>>);

/// A range that may grow.
#[derive(Clone, Copy, Debug)]
struct Row {
    first: u64,
    count: u64,
}

/// The common properties of the numbers in a range.
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
    /// Notes that this message was sent.
    pub(super) fn sent(&self, to: Station, class: Class, number: u64, asked: bool) {
        let other = Column::Sent { to, class, asked: !asked };
        self.with(|book| {
            // Lines are printed in the order of the numbers.
            book.close(other);
            book.add(Column::Sent { to, class, asked }, number);
        });
    }

    /// Notes that this message was received. A confirmed message is printed at once, with all earlier notes.
    pub(super) fn got(&self, from: Party, class: Class, number: u64, is_awaited: bool) {
        self.with(|book| {
            book.add(Column::Got { from, class }, number);
            if is_awaited {
                book.report();
            }
        });
    }

    /// Adds a note after all earlier ones.
    pub(super) fn note(&self, note: Note) {
        self.with(|book| {
            book.close_all();
            book.write(&note);
        });
    }

    /// Prints all notes now.
    pub(super) fn report(&self) {
        self.with(Book::report);
    }

    fn with(&self, act: impl FnOnce(&mut Book)) {
        act(&mut lock(&self.0));
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

    /// Writes complete lines, before the sender of a confirmed message continues: the notes of a killed
    /// process are not lost.
    fn report(&mut self) {
        self.close_all();
        let mut out = std::io::stdout().lock();
        // The scenario is gone, and this process will soon be, too.
        let _ = out.write_all(self.text.as_bytes()).and_then(|()| out.flush());
        self.text.clear();
    }
}
