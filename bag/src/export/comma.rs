//! Text with commas.

use std::{fs::File, io};

use super::{
    Row, Table,
    columns::{Cell, Columns},
};

/// A file of text with commas.
pub(super) struct Comma {
    writer: csv::Writer<File>,
    columns: Columns,
}

impl Comma {
    pub(super) fn new(file: File, columns: &Columns) -> io::Result<Self> {
        let mut writer = csv::Writer::from_writer(file);
        writer.write_record(columns.described().iter().map(|(name, _)| name))?;
        Ok(Self { writer, columns: columns.clone() })
    }
}

impl Table for Comma {
    fn row(&mut self, row: &Row) -> io::Result<()> {
        let cells = self.columns.cells(row);
        let texts = cells.iter().map(|cell| cell.as_ref().map(Cell::text).unwrap_or_default());
        Ok(self.writer.write_record(texts)?)
    }

    fn finish(mut self: Box<Self>) -> io::Result<()> {
        self.writer.flush()
    }
}
