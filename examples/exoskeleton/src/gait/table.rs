//! Reads named columns of numbers from a CSV text with `#` comment lines, and says where and why when it cannot.

use thiserror::Error;

/// Most rows that are read; a longer file is refused rather than filling the memory (2 h 46 min at 100 Hz).
pub const ROWS_MAX: usize = 1_000_000;

/// Why a table could not be read. Each text names the line and what to do.
#[derive(Debug, Error)]
pub enum TableError {
    /// The file could not be opened or read.
    #[error("cannot read {path}: {reason}; check the path and its permissions")]
    Unreadable {
        /// The path as given.
        path: String,
        /// The system's words.
        reason: String,
    },
    /// No header line holds this column.
    #[error("column `{column}` is missing in the header; add it, spelled like this")]
    ColumnMissing {
        /// The name looked for.
        column: String,
    },
    /// The text is not a CSV record, or not UTF-8.
    #[error("line {line}: not a CSV record of the header's length ({reason}); repair or remove the line")]
    RecordGarbled {
        /// Line in the file, from 1.
        line: u64,
        /// The CSV reader's words.
        reason: String,
    },
    /// A field is not a finite number.
    #[error("line {line}, column `{column}`: `{found}` is not a finite number; repair or remove the line")]
    NotANumber {
        /// Line in the file, from 1.
        line: u64,
        /// The column's name.
        column: String,
        /// What stands there, cut to 40 characters.
        found: String,
    },
    /// More than [`ROWS_MAX`] rows.
    #[error("line {line}: more than {ROWS_MAX} rows; cut the file into shorter trials")]
    TooLong {
        /// Line in the file, from 1.
        line: u64,
    },
}

/// One row: the wanted columns in the wanted order.
#[derive(Debug, Clone, PartialEq)]
pub struct TableRow {
    /// Line in the file, from 1.
    pub line: u64,
    /// The numbers, all finite.
    pub values: Vec<f64>,
}

/// The wanted columns of a CSV text, all numbers finite.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    rows: Vec<TableRow>,
}

impl Table {
    /// Reads `columns` from `text`; other columns are ignored.
    ///
    /// # Errors
    /// [`TableError`] for a missing column, a garbled record, a field that is no finite number, or too many rows.
    pub fn parse(text: &str, columns: &[&str]) -> Result<Self, TableError> {
        let mut reader =
            csv::ReaderBuilder::new().comment(Some(b'#')).trim(csv::Trim::All).from_reader(text.as_bytes());
        let header = reader.headers().map_err(|e| garbled(&e))?.clone();
        let places = columns
            .iter()
            .map(|name| {
                header
                    .iter()
                    .position(|h| h == *name)
                    .ok_or_else(|| TableError::ColumnMissing { column: (*name).to_owned() })
            })
            .collect::<Result<Vec<_>, _>>()?;
        let mut rows = Vec::new();
        for record in reader.records() {
            let record = record.map_err(|e| garbled(&e))?;
            let line = record.position().map_or(0, csv::Position::line);
            if rows.len() == ROWS_MAX {
                return Err(TableError::TooLong { line });
            }
            let values = columns
                .iter()
                .zip(&places)
                .map(|(name, place)| number(record.get(*place).unwrap_or(""), line, name))
                .collect::<Result<Vec<_>, _>>()?;
            rows.push(TableRow { line, values });
        }
        Ok(Self { rows })
    }

    /// The rows in the order of the file.
    #[must_use]
    pub fn rows(&self) -> &[TableRow] {
        &self.rows
    }

    /// All values of the wanted column with this place.
    #[must_use]
    pub fn column(&self, place: usize) -> Vec<f64> {
        self.rows.iter().map(|row| row.values[place]).collect()
    }
}

fn number(field: &str, line: u64, column: &str) -> Result<f64, TableError> {
    match field.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        Ok(_) | Err(_) => Err(TableError::NotANumber {
            line,
            column: column.to_owned(),
            found: field.chars().take(40).collect(),
        }),
    }
}

fn garbled(error: &csv::Error) -> TableError {
    TableError::RecordGarbled {
        line: error.position().map_or(0, csv::Position::line),
        reason: error.to_string(),
    }
}
