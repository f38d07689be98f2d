//! Values of one side as values of the other one.

use std::fmt;

use crate::{
    catalog::{Count, Element},
    path::{Expression, Target},
    payload::Payload,
    value::Value,
};

/// A value that does not fit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConvertError(String);

impl ConvertError {
    pub(crate) fn new(why: impl Into<String>) -> Self {
        Self(why.into())
    }

    pub(crate) fn at(path: impl fmt::Display, why: &Self) -> Self {
        Self(format!("{path}: {}", why.0))
    }
}

impl fmt::Display for ConvertError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for ConvertError {}

/// Returns the value of a field of a message for a field of a payload.
pub(crate) fn to_ros(target: &Target, payload: &Payload, by: &Expression) -> Result<Value, ConvertError> {
    if target.count == Count::One {
        return one_to_ros(&target.element, payload, by);
    }
    let values: Vec<_> = match payload {
        Payload::List(values) => {
            values.iter().map(|value| one_to_ros(&target.element, value, by)).collect::<Result<_, _>>()?
        }
        Payload::Bytes(bytes) => {
            let one = |byte: &u8| one_to_ros(&target.element, &Payload::Integer((*byte).into()), by);
            bytes.iter().map(one).collect::<Result<_, _>>()?
        }
        Payload::Nil
        | Payload::Bool(_)
        | Payload::Integer(_)
        | Payload::Unsigned(_)
        | Payload::Float(_)
        | Payload::Text(_)
        | Payload::Map(_) => return Err(misfit("a list", payload)),
    };
    let has_room = match target.count {
        Count::Array(length) => values.len() == length as usize,
        Count::Bounded(max) => values.len() <= max as usize,
        Count::One | Count::Unbounded => true,
    };
    if has_room {
        Ok(Value::List(values))
    } else {
        Err(ConvertError(format!("{} values do not fit", values.len())))
    }
}

fn one_to_ros(element: &Element, payload: &Payload, by: &Expression) -> Result<Value, ConvertError> {
    match (element, payload) {
        (Element::Bool, Payload::Bool(value)) if by.is_plain() => Ok(Value::Bool(*value)),
        (Element::Text(_), Payload::Text(text)) if by.is_plain() => Ok(Value::Text(text.clone())),
        // An `Option` without a value.
        (Element::Float(_), Payload::Nil) => Ok(Value::Float(f64::NAN)),
        (Element::Float(_), number) => number
            .number()
            .map(|number| Value::Float(by.apply(number)))
            .ok_or_else(|| misfit("a number", number)),
        (Element::Signed(bits), number) => {
            let (min, max) = (i64::MIN >> (64 - u32::from(*bits)), i64::MAX >> (64 - u32::from(*bits)));
            let whole = whole(number, by)?;
            let value = i64::try_from(whole).ok().filter(|value| (min..=max).contains(value));
            value
                .map(Value::Signed)
                .ok_or_else(|| ConvertError(format!("{whole} is not from {min} to {max}")))
        }
        (Element::Byte, number) => unsigned(8, number, by),
        (Element::Unsigned(bits), number) => unsigned(*bits, number, by),
        (Element::Bool, other) => Err(misfit("a truth, without a factor", other)),
        (Element::Text(_), other) => Err(misfit("a text, without a factor", other)),
        (Element::Message(_), other) => Err(misfit("a message", other)),
    }
}

fn unsigned(bits: u8, number: &Payload, by: &Expression) -> Result<Value, ConvertError> {
    let max = u64::MAX >> (64 - u32::from(bits));
    let whole = whole(number, by)?;
    let value = u64::try_from(whole).ok().filter(|value| *value <= max);
    value.map(Value::Unsigned).ok_or_else(|| ConvertError(format!("{whole} is not from 0 to {max}")))
}

/// Returns a whole number: the same one, or, with a factor, the nearest one to the result.
fn whole(payload: &Payload, by: &Expression) -> Result<i128, ConvertError> {
    match payload {
        Payload::Integer(number) if by.is_plain() => return Ok((*number).into()),
        Payload::Unsigned(number) if by.is_plain() => return Ok((*number).into()),
        Payload::Nil
        | Payload::Bool(_)
        | Payload::Integer(_)
        | Payload::Unsigned(_)
        | Payload::Float(_)
        | Payload::Text(_)
        | Payload::Bytes(_)
        | Payload::List(_)
        | Payload::Map(_) => {}
    }
    let number = payload.number().ok_or_else(|| misfit("a whole number", payload))?;
    let result = by.apply(number);
    let rounded = if by.is_plain() { result } else { result.round() };
    // The conversion saturates, and both ends are beyond every integer of ROS.
    if rounded.is_finite() && rounded.fract() == 0.0 {
        Ok(rounded as i128)
    } else {
        Err(ConvertError(format!("{result} is no whole number")))
    }
}

/// Returns the value of a field of a payload for a field of a message. A number that is not finite is refused: nothing
/// in a robot can follow it.
pub(crate) fn to_sinew(value: &Value, by: &Expression) -> Result<Payload, ConvertError> {
    let float = |number: f64| {
        let result = by.apply(number);
        if result.is_finite() {
            Ok(Payload::Float(result))
        } else {
            Err(ConvertError(format!("{result} is not finite")))
        }
    };
    match value {
        Value::Signed(number) if by.is_plain() => Ok(Payload::Integer(*number)),
        Value::Signed(number) => float(*number as f64),
        Value::Unsigned(number) if by.is_plain() => {
            Ok(i64::try_from(*number).map_or(Payload::Unsigned(*number), Payload::Integer))
        }
        Value::Unsigned(number) => float(*number as f64),
        Value::Float(number) => float(*number),
        Value::Bool(value) if by.is_plain() => Ok(Payload::Bool(*value)),
        Value::Text(text) if by.is_plain() => Ok(Payload::Text(text.clone())),
        Value::List(values) => {
            values.iter().map(|value| to_sinew(value, by)).collect::<Result<_, _>>().map(Payload::List)
        }
        Value::Bool(_) | Value::Text(_) | Value::Message(_) => {
            Err(ConvertError("only a number has a factor, and a message has no value of its own".to_owned()))
        }
    }
}

fn misfit(expected: &str, found: &Payload) -> ConvertError {
    let found = match found {
        Payload::Nil => "nothing",
        Payload::Bool(_) => "a truth",
        Payload::Integer(_) | Payload::Unsigned(_) | Payload::Float(_) => "a number",
        Payload::Text(_) => "a text",
        Payload::Bytes(_) => "bytes",
        Payload::List(_) => "a list",
        Payload::Map(_) => "a structure",
    };
    ConvertError(format!("{found} in place of {expected}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn by(text: &str) -> Expression {
        Expression::parse(text).expect("an expression")
    }

    fn int8(payload: &Payload, text: &str) -> Result<Value, ConvertError> {
        one_to_ros(&Element::Signed(8), payload, &by(text))
    }

    #[test]
    fn numbers_keep_their_values_or_are_refused() {
        assert_eq!(int8(&Payload::Integer(-128), "x"), Ok(Value::Signed(-128)));
        assert!(int8(&Payload::Integer(128), "x").is_err() && int8(&Payload::Float(0.5), "x").is_err());
        assert_eq!(int8(&Payload::Float(0.6), "x * 10"), Ok(Value::Signed(6)));
        assert!(int8(&Payload::Float(f64::NAN), "x").is_err() && int8(&Payload::Bool(true), "x").is_err());
        let wide = one_to_ros(&Element::Unsigned(64), &Payload::Unsigned(u64::MAX), &by("x"));
        assert_eq!(wide, Ok(Value::Unsigned(u64::MAX)));
        assert!(one_to_ros(&Element::Byte, &Payload::Integer(256), &by("x")).is_err());
    }

    #[test]
    fn absent_number_is_no_number() {
        let value = one_to_ros(&Element::Float(64), &Payload::Nil, &by("x * 2"));
        assert!(matches!(value, Ok(Value::Float(number)) if number.is_nan()));
        assert!(int8(&Payload::Nil, "x").is_err());
    }

    #[test]
    fn commands_are_finite() {
        assert_eq!(to_sinew(&Value::Float(2.0), &by("x / 4")), Ok(Payload::Float(0.5)));
        for bad in [f64::NAN, f64::INFINITY, 1e308] {
            assert!(to_sinew(&Value::Float(bad), &by("x * 1000")).is_err(), "{bad}");
        }
        assert!(to_sinew(&Value::List(vec![Value::Float(f64::NAN)]), &by("x")).is_err());
        assert!(to_sinew(&Value::Text("1".to_owned()), &by("x * 2")).is_err());
    }
}
