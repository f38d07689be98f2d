//! Reads named columns of numbers from a CSV text with `#` comment lines; an error names the place and the
//! cause.

use thiserror::Error;

/// Maximum number of bytes that are read.
pub const BYTES_MAX: u64 = 512 << 20;
/// The optional column that is 1 where the recording has a gap.
const GAP: &str = "gap";
/// Maximum number of rows; a longer file is rejected rather than filling the memory (2 h 46 min at 100 Hz).
pub const ROWS_MAX: usize = 1_000_000;

/// The reason why a table could not be read. Each text names the line and the remedy.
#[derive(Debug, Error)]
pub enum TableError {
    /// The file could not be opened or read.
    #[error("cannot read {path}: {reason}; check the path and its permissions")]
    Unreadable {
        /// The path as given.
        path: String,
        /// The text of the system.
        reason: String,
    },
    /// No header line holds this column.
    #[error("column `{column}` is missing in the header; add it, spelled like this")]
    ColumnMissing {
        /// The requested name.
        column: String,
    },
    /// A header line holds this column twice.
    #[error("column `{column}` is in the header {times} times; keep one of them")]
    ColumnRepeated {
        /// The column's name.
        column: String,
        /// Number of occurrences.
        times: usize,
    },
    /// The columns are not separated by commas.
    #[error("line {line}: columns are separated by {found}; write commas, and decimal points in the numbers")]
    Separator {
        /// Line of the header, from 1.
        line: u64,
        /// The separator found.
        found: &'static str,
    },
    /// The file is longer than any trial.
    #[error("{path}: longer than {} MB; cut the file into shorter trials", BYTES_MAX >> 20)]
    TooLarge {
        /// The path as given.
        path: String,
    },
    /// The text is not a CSV record, or not UTF-8.
    #[error("line {line}: not a CSV record of the header's length ({reason}); repair or remove the line")]
    RecordGarbled {
        /// Line in the file, from 1.
        line: u64,
        /// The text of the CSV reader.
        reason: String,
    },
    /// A field is not a finite number.
    #[error(
        "line {line}, column `{column}`: `{found}` is not a finite number{hint}; repair the line, or mark it with `gap` 1"
    )]
    NotANumber {
        /// Line in the file, from 1.
        line: u64,
        /// The column's name.
        column: String,
        /// The field's text, cut to 40 characters.
        found: String,
        /// The possible cause; empty if none is known.
        hint: &'static str,
    },
    /// More than [`ROWS_MAX`] rows.
    #[error("line {line}: more than {ROWS_MAX} rows; cut the file into shorter trials")]
    TooLong {
        /// Line in the file, from 1.
        line: u64,
    },
}

/// One row: the requested columns in the requested order.
#[derive(Debug, Clone, PartialEq)]
pub struct TableRow {
    /// Line in the file, from 1.
    pub line: u64,
    /// The numbers, all finite outside of gaps; a gap has NaN for a missing one.
    pub values: Vec<f64>,
    /// Whether the file marks this row as a gap of the recording.
    pub is_gap: bool,
}

/// The requested columns of a CSV text.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    rows: Vec<TableRow>,
}

impl Table {
    /// Reads `columns` from `text`, and `gap` if it exists; other columns are ignored.
    ///
    /// # Errors
    /// [`TableError`] for another separator, a missing column, a garbled record, a field that is no finite
    /// number, or too many rows.
    pub fn parse(text: &str, columns: &[&str]) -> Result<Self, TableError> {
        // Spreadsheets begin a file with a byte order mark.
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let mut reader =
            csv::ReaderBuilder::new().comment(Some(b'#')).trim(csv::Trim::All).from_reader(text.as_bytes());
        let header = reader.headers().map_err(|e| garbled(&e))?.clone();
        check_separator(&header)?;
        let places = columns.iter().map(|name| place(&header, name)).collect::<Result<Vec<_>, _>>()?;
        let gap = header.iter().any(|h| h == GAP).then(|| place(&header, GAP)).transpose()?;
        let mut rows = Vec::new();
        for record in reader.records() {
            let record = record.map_err(|e| garbled(&e))?;
            let line = record.position().map_or(0, csv::Position::line);
            if rows.len() == ROWS_MAX {
                return Err(TableError::TooLong { line });
            }
            let field = |place: usize| record.get(place).unwrap_or("");
            let is_gap = match gap {
                Some(place) => number(field(place), line, GAP)? != 0.0,
                None => false,
            };
            let value = |(name, place): (&&str, &usize)| match number(field(*place), line, name) {
                Err(_) if is_gap => Ok(f64::NAN),
                read => read,
            };
            let values = columns.iter().zip(&places).map(value).collect::<Result<Vec<_>, _>>()?;
            rows.push(TableRow { line, values, is_gap });
        }
        Ok(Self { rows })
    }

    /// The rows in the order of the file.
    #[must_use]
    pub fn rows(&self) -> &[TableRow] {
        &self.rows
    }
}

fn place(header: &csv::StringRecord, name: &str) -> Result<usize, TableError> {
    let column = || name.to_owned();
    let mut places = header.iter().enumerate().filter(|(_, h)| *h == name).map(|(place, _)| place);
    let first = places.next().ok_or_else(|| TableError::ColumnMissing { column: column() })?;
    match places.count() {
        0 => Ok(first),
        more => Err(TableError::ColumnRepeated { column: column(), times: 1 + more }),
    }
}

/// A header with another separator is one long name.
fn check_separator(header: &csv::StringRecord) -> Result<(), TableError> {
    let line = header.position().map_or(0, csv::Position::line);
    let text = header.iter().collect::<Vec<_>>().join(",");
    for (separator, found) in [('\t', "tabs"), (';', "semicolons"), ('|', "`|`")] {
        if text.contains(separator) && header.len() < text.matches(separator).count() + 1 {
            return Err(TableError::Separator { line, found });
        }
    }
    if header.len() == 1 && text.split_ascii_whitespace().count() > 1 {
        return Err(TableError::Separator { line, found: "spaces" });
    }
    Ok(())
}

fn number(field: &str, line: u64, column: &str) -> Result<f64, TableError> {
    match field.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        Ok(_) | Err(_) => Err(TableError::NotANumber {
            line,
            column: column.to_owned(),
            found: field.chars().take(40).collect(),
            hint: if field.contains(',') { " (a decimal comma? write a point)" } else { "" },
        }),
    }
}

fn garbled(error: &csv::Error) -> TableError {
    TableError::RecordGarbled {
        line: error.position().map_or(0, csv::Position::line),
        reason: error.to_string(),
    }
}
