//! A schema as a person reads it.

use std::fmt;

use crate::shape::{Field, Schema, Shape, Variant};

impl fmt::Display for Schema {
    /// Writes the structure of the payload, then each type inside it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_top(&self.root, f)?;
        for (name, shape) in &self.types {
            write!(f, "{} = ", name.escape_debug())?;
            write_top(shape, f)?;
        }
        Ok(())
    }
}

/// Writes a struct or an enum in lines of its own, and anything else in one line.
fn write_top(shape: &Shape, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    if let Shape::Struct(fields) = shape
        && !fields.is_empty()
    {
        f.write_str("{\n")?;
        for Field { name, shape, optional } in fields {
            let absent = if *optional { ", may be absent" } else { "" };
            writeln!(f, "    {}: {shape}{absent},", name.escape_debug())?;
        }
        return f.write_str("}\n");
    }
    if let Shape::Enum(variants) = shape
        && !variants.is_empty()
    {
        f.write_str("one of {\n")?;
        variants.iter().try_for_each(|variant| writeln!(f, "    {variant},"))?;
        return f.write_str("}\n");
    }
    writeln!(f, "{shape}")
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, shape } = self;
        write!(f, "{}", name.escape_debug())?;
        if let Shape::Newtype(inner) = shape {
            write!(f, "({inner})")
        } else if matches!(shape, Shape::Struct(_)) {
            write!(f, " {shape}")
        } else if *shape == Shape::Unit {
            Ok(())
        } else {
            write!(f, "{shape}")
        }
    }
}

impl fmt::Display for Shape {
    /// Writes the shape in one line.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unit => f.write_str("nothing"),
            Self::Bool => f.write_str("bool"),
            Self::I8 => f.write_str("i8"),
            Self::I16 => f.write_str("i16"),
            Self::I32 => f.write_str("i32"),
            Self::I64 => f.write_str("i64"),
            Self::I128 => f.write_str("i128"),
            Self::U8 => f.write_str("u8"),
            Self::U16 => f.write_str("u16"),
            Self::U32 => f.write_str("u32"),
            Self::U64 => f.write_str("u64"),
            Self::U128 => f.write_str("u128"),
            Self::F32 => f.write_str("f32"),
            Self::F64 => f.write_str("f64"),
            Self::Char => f.write_str("char"),
            Self::Text => f.write_str("text"),
            Self::Bytes => f.write_str("bytes"),
            Self::Option(inner) => write!(f, "optional {inner}"),
            Self::List(inner) => write!(f, "list of {inner}"),
            Self::Array(inner, length) => write!(f, "{length} x {inner}"),
            Self::Tuple(parts) => {
                let parts: Vec<_> = parts.iter().map(ToString::to_string).collect();
                write!(f, "({})", parts.join(", "))
            }
            Self::Map(key, value) => write!(f, "map from {key} to {value}"),
            Self::Struct(fields) => {
                let part = |field: &Field| format!("{}: {}", field.name.escape_debug(), field.shape);
                let parts: Vec<_> = fields.iter().map(part).collect();
                if parts.is_empty() { f.write_str("{}") } else { write!(f, "{{ {} }}", parts.join(", ")) }
            }
            Self::Newtype(inner) => inner.fmt(f),
            Self::Enum(variants) => {
                let parts: Vec<_> = variants.iter().map(ToString::to_string).collect();
                write!(f, "one of {{ {} }}", parts.join(", "))
            }
            Self::Named(name) => write!(f, "{}", name.escape_debug()),
        }
    }
}
