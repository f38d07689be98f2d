//! Paths of fields, and the expressions of a mapping file: `joints[0].angle * 57.3 + 1`.

use std::fmt;

use crate::{
    catalog::{Count, Element, Structure},
    payload::Payload,
    value::Value,
};

/// Maximum steps of a path.
const STEPS_MAX: usize = 16;
/// Maximum bytes of an expression.
const TEXT_BYTES_MAX: usize = 512;
/// Maximum index of a value in a list.
const INDEX_MAX: usize = 1_023;

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    Name(String),
    Index(usize),
}

/// The path of a field. The empty one is the whole value, written as `.`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Path(Vec<Step>);

impl Path {
    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        if text == "." {
            return Ok(Self(Vec::new()));
        }
        let fault = || format!("'{text}' is no path of a field, as joints[0].angle");
        if text.len() > TEXT_BYTES_MAX {
            return Err(format!("a path has more than {TEXT_BYTES_MAX} bytes"));
        }
        let mut steps = Vec::new();
        for part in text.split('.') {
            let (name, indices) =
                part.split_once('[').map_or((part, None), |(name, rest)| (name, Some(rest)));
            if name.is_empty() || name.contains(|c: char| c.is_whitespace() || c.is_control() || c == ']') {
                return Err(fault());
            }
            steps.push(Step::Name(name.to_owned()));
            for index in indices.map(|rest| rest.split('[')).into_iter().flatten() {
                let index = index.strip_suffix(']').and_then(|digits| digits.parse().ok());
                steps.push(Step::Index(index.filter(|index| *index <= INDEX_MAX).ok_or_else(fault)?));
            }
        }
        if steps.len() > STEPS_MAX {
            return Err(format!("'{text}' has more than {STEPS_MAX} steps"));
        }
        Ok(Self(steps))
    }

    /// Returns the names, if there are no indices.
    pub(crate) fn names(&self) -> Option<Vec<&str>> {
        self.0
            .iter()
            .map(|step| if let Step::Name(name) = step { Some(name.as_str()) } else { None })
            .collect()
    }

    /// Returns the field of a payload.
    pub(crate) fn find<'p>(&self, payload: &'p Payload) -> Option<&'p Payload> {
        self.0.iter().try_fold(payload, |payload, step| match (step, payload) {
            (Step::Name(name), Payload::Map(members)) => {
                members.iter().find(|(known, _)| known == name).map(|(_, value)| value)
            }
            (Step::Index(index), Payload::List(values)) => values.get(*index),
            (Step::Name(_) | Step::Index(_), _) => None,
        })
    }
}

impl fmt::Display for Path {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (at, step) in self.0.iter().enumerate() {
            match step {
                Step::Name(name) if at == 0 => f.write_str(name)?,
                Step::Name(name) => write!(f, ".{name}")?,
                Step::Index(index) => write!(f, "[{index}]")?,
            }
        }
        if self.0.is_empty() { f.write_str(".") } else { Ok(()) }
    }
}

/// A field with a factor and an offset.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Expression {
    pub(crate) path: Path,
    factor: f64,
    offset: f64,
}

impl Expression {
    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        let fault = || format!("'{text}' is no expression, as: angle * 57.3 + 1, or: angle / 1000");
        let number = |text: Option<&str>| {
            let number: Option<f64> = text.and_then(|text| text.parse().ok());
            number.filter(|number| number.is_finite()).ok_or_else(fault)
        };
        let mut words = text.split_whitespace().peekable();
        let path = Path::parse(words.next().ok_or_else(fault)?)?;
        let mut expression = Self { path, factor: 1.0, offset: 0.0 };
        if let Some(operator) = words.next_if(|word| matches!(*word, "*" | "/")) {
            let number = number(words.next())?;
            expression.factor = if operator == "*" { number } else { 1.0 / number };
        }
        if let Some(operator) = words.next_if(|word| matches!(*word, "+" | "-")) {
            let number = number(words.next())?;
            expression.offset = if operator == "+" { number } else { -number };
        }
        let is_usable = expression.factor.is_finite() && expression.factor != 0.0;
        if words.next().is_some() || !is_usable { Err(fault()) } else { Ok(expression) }
    }

    /// Returns whether it changes nothing.
    pub(crate) const fn is_plain(&self) -> bool {
        self.factor == 1.0 && self.offset == 0.0
    }

    pub(crate) fn apply(&self, number: f64) -> f64 {
        if self.is_plain() { number } else { number * self.factor + self.offset }
    }

    /// The constant that takes a value as it is.
    pub(crate) const fn plain(path: Path) -> Self {
        Self { path, factor: 1.0, offset: 0.0 }
    }
}

#[derive(Clone, Debug)]
enum Place {
    Member(usize),
    /// An item of a list, with the type of its values.
    Item(usize, Element),
}

/// A field of a message type.
#[derive(Clone, Debug)]
pub(crate) struct Target {
    places: Vec<Place>,
    pub(crate) element: Element,
    /// [`Count::One`] for an item of a list.
    pub(crate) count: Count,
}

impl Target {
    /// Finds a field without members of its own.
    pub(crate) fn locate(of: &Structure, path: &Path) -> Result<Self, String> {
        let fault = |why: &str| format!("'{path}' is no field of {}: {why}", of.name);
        let (mut places, mut structure, mut steps) = (Vec::new(), of, path.0.iter().peekable());
        loop {
            let Some(Step::Name(name)) = steps.next() else { return Err(fault("it ends at a message")) };
            let Some((place, member)) = structure.member(name) else {
                let names: Vec<_> = structure.members.iter().map(|member| member.name.as_str()).collect();
                return Err(fault(&format!("{} has {}", structure.name, names.join(", "))));
            };
            places.push(Place::Member(place));
            let mut count = member.count;
            if let Some(&&Step::Index(index)) = steps.peek() {
                let is_inside = match count {
                    Count::One => return Err(fault(&format!("{name} is no list"))),
                    Count::Array(length) | Count::Bounded(length) => index < length as usize,
                    Count::Unbounded => true,
                };
                if !is_inside {
                    return Err(fault(&format!("{name} has no index {index}")));
                }
                steps.next();
                places.push(Place::Item(index, member.element.clone()));
                count = Count::One;
            }
            match (&member.element, steps.peek()) {
                (Element::Message(inner), Some(_)) if count == Count::One => structure = inner,
                (Element::Message(_), _) => return Err(fault("name a field of the message in it")),
                (_, Some(_)) => return Err(fault(&format!("{name} has no fields"))),
                (element, None) => return Ok(Self { places, element: element.clone(), count }),
            }
        }
    }

    pub(crate) fn get<'v>(&self, value: &'v Value) -> Option<&'v Value> {
        self.places.iter().try_fold(value, |value, place| match place {
            Place::Member(at) | Place::Item(at, _) => value.at(*at),
        })
    }

    /// Sets the field. A list that is shorter gets zeros in between.
    pub(crate) fn set(&self, value: &mut Value, new: Value) {
        let mut slot = value;
        for place in &self.places {
            slot = match (place, slot) {
                (Place::Member(at), Value::Message(values)) => &mut values[*at],
                (Place::Item(at, element), Value::List(values)) => {
                    while values.len() <= *at {
                        values.push(Value::zero_element(element));
                    }
                    &mut values[*at]
                }
                // A value of another type has no such field.
                (Place::Member(_) | Place::Item(..), _) => return,
            };
        }
        *slot = new;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::catalog::Catalog;

    #[test]
    fn expressions_have_factor_and_offset() {
        let of =
            |text: &str| Expression::parse(text).map(|found| (found.path.to_string(), found.apply(10.0)));
        assert_eq!(of("angle"), Ok(("angle".to_owned(), 10.0)));
        assert_eq!(of("legs[1].angle * 2 + 1"), Ok(("legs[1].angle".to_owned(), 21.0)));
        assert_eq!(of(". / 4 - 0.5"), Ok((".".to_owned(), 2.0)));
        for bad in [
            "",
            "a b",
            "a *",
            "a * x",
            "a * 0",
            "a / 0",
            "a * inf",
            "a + 1 * 2",
            "a[",
            "a[x]",
            "a[9999]",
            "a..b",
            "[0]",
        ] {
            assert!(of(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn fields_are_found_and_set() {
        let of = Catalog::shipped().message("sensor_msgs/msg/JointState").expect("a type");
        let target = |text: &str| Target::locate(&of, &Path::parse(text).expect("a path"));
        let mut value = Value::zero(&of);
        target("position[2]").expect("a field").set(&mut value, Value::Float(3.0));
        target("header.frame_id").expect("a field").set(&mut value, Value::Text("leg".to_owned()));
        let positions = target("position").expect("a field");
        assert_eq!(positions.get(&value).map(|list| list.list().len()), Some(3));
        for (bad, words) in [
            ("header", "name a field"),
            ("header.nothing", "std_msgs/msg/Header has stamp, frame_id"),
            ("header[0]", "no list"),
            ("position[0].x", "no fields"),
        ] {
            let why = target(bad).expect_err(bad);
            assert!(why.contains(words), "{bad}: {why}");
        }
    }

    #[test]
    fn index_beyond_an_array_is_refused() {
        let of = Catalog::shipped().message("sensor_msgs/msg/Imu").expect("a type");
        let target = |text: &str| Target::locate(&of, &Path::parse(text).expect("a path"));
        assert!(target("orientation_covariance[8]").is_ok() && target("orientation.w").is_ok());
        assert!(target("orientation_covariance[9]").expect_err("beyond").contains("no index 9"));
    }

    proptest! {
        #[test]
        fn any_text_is_an_expression_or_none(text in "[ -~]{0,60}") {
            let _ = Expression::parse(&text);
        }
    }
}
