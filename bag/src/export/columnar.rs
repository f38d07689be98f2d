//! Apache Parquet.

use std::{fs::File, io, sync::Arc};

use parquet::{
    basic::{Compression, ConvertedType, Repetition, Type as Physical},
    data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, Int64Type},
    errors::ParquetError,
    file::{
        properties::WriterProperties,
        writer::{SerializedColumnWriter, SerializedFileWriter},
    },
    schema::types::Type as Schema,
};

use super::{
    Row, Table,
    columns::{Cell, Columns, Type},
};

/// Maximum values of a group of rows, which is in memory until it is written.
const CELLS_MAX: usize = 1 << 18;

/// A file in Parquet.
pub(super) struct Parquet {
    writer: SerializedFileWriter<File>,
    columns: Columns,
    kinds: Vec<Type>,
    /// The values of the current group, column by column.
    cells: Vec<Vec<Option<Cell>>>,
}

impl Parquet {
    pub(super) fn new(file: File, columns: &Columns) -> io::Result<Self> {
        let described = columns.described();
        let fields = described.iter().map(|(name, kind)| field(name, *kind).map(Arc::new));
        let fields = fields.collect::<Result<Vec<_>, _>>().map_err(cause)?;
        let schema = Schema::group_type_builder("message").with_fields(fields).build().map_err(cause)?;
        let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
        let writer =
            SerializedFileWriter::new(file, Arc::new(schema), Arc::new(properties)).map_err(cause)?;
        let kinds: Vec<_> = described.into_iter().map(|(_, kind)| kind).collect();
        Ok(Self { writer, columns: columns.clone(), cells: vec![Vec::new(); kinds.len()], kinds })
    }

    fn write_out(&mut self) -> Result<(), ParquetError> {
        if self.cells[0].is_empty() {
            return Ok(());
        }
        let mut group = self.writer.next_row_group()?;
        for (cells, kind) in self.cells.iter_mut().zip(&self.kinds) {
            let Some(mut column) = group.next_column()? else { break };
            match kind {
                Type::Bool => typed::<BoolType>(&mut column, cells, |cell| matches!(cell, Cell::Bool(true)))?,
                Type::Unsigned | Type::Signed => typed::<Int64Type>(&mut column, cells, whole)?,
                Type::Double => typed::<DoubleType>(&mut column, cells, double)?,
                Type::Text => typed::<ByteArrayType>(&mut column, cells, |cell| {
                    ByteArray::from(cell.text().into_bytes())
                })?,
            }
            column.close()?;
            cells.clear();
        }
        group.close()?;
        Ok(())
    }
}

impl Table for Parquet {
    fn row(&mut self, row: &Row) -> io::Result<()> {
        for (column, cell) in self.cells.iter_mut().zip(self.columns.cells(row)) {
            column.push(cell);
        }
        if self.cells[0].len() * self.cells.len() >= CELLS_MAX {
            self.write_out().map_err(cause)?;
        }
        Ok(())
    }

    fn finish(mut self: Box<Self>) -> io::Result<()> {
        self.write_out().map_err(cause)?;
        self.writer.close().map(|_| ()).map_err(cause)
    }
}

fn field(name: &str, kind: Type) -> Result<Schema, ParquetError> {
    let (physical, converted) = match kind {
        Type::Bool => (Physical::BOOLEAN, ConvertedType::NONE),
        Type::Unsigned => (Physical::INT64, ConvertedType::UINT_64),
        Type::Signed => (Physical::INT64, ConvertedType::INT_64),
        Type::Double => (Physical::DOUBLE, ConvertedType::NONE),
        Type::Text => (Physical::BYTE_ARRAY, ConvertedType::UTF8),
    };
    let builder = Schema::primitive_type_builder(name, physical);
    builder.with_repetition(Repetition::OPTIONAL).with_converted_type(converted).build()
}

/// Writes a column. Absent values have the level 0.
fn typed<T: DataType>(
    column: &mut SerializedColumnWriter<'_>,
    cells: &[Option<Cell>],
    value: impl Fn(&Cell) -> T::T,
) -> Result<(), ParquetError> {
    let levels: Vec<i16> = cells.iter().map(|cell| i16::from(cell.is_some())).collect();
    let values: Vec<T::T> = cells.iter().flatten().map(value).collect();
    column.typed::<T>().write_batch(&values, Some(&levels), None)?;
    Ok(())
}

/// Returns a whole number as its bits. The column says if it is signed.
fn whole(cell: &Cell) -> i64 {
    match cell {
        Cell::Unsigned(value) => *value as i64,
        Cell::Negative(value) => *value,
        Cell::Bool(_) | Cell::Float(_) | Cell::Double(_) | Cell::Text(_) => 0,
    }
}

fn double(cell: &Cell) -> f64 {
    match cell {
        Cell::Unsigned(value) => *value as f64,
        Cell::Negative(value) => *value as f64,
        Cell::Float(value) => f64::from(*value),
        Cell::Double(value) => *value,
        Cell::Bool(_) | Cell::Text(_) => f64::NAN,
    }
}

fn cause(error: ParquetError) -> io::Error {
    io::Error::other(error)
}
