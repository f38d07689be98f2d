//! Reads the tables of a robot file by their keys and types, and collects the faults.

use std::collections::BTreeMap;

use sinew::{
    name::{NAME_BYTES_MAX, check_node_name},
    nearest::nearest,
};
use sinew_model::config::{ConfigFault, fault, line_of, quoted, shown};
use toml::{
    Spanned,
    de::{DeString, DeTable, DeValue},
};

use super::{
    HERE,
    rows::{HOSTS_MAX, Kind, NODES_MAX, ROWS, Row, TEXT_BYTES_MAX, Table},
};

/// A value of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Value {
    Text(String),
    Truth(bool),
    Number(i64),
    Texts(Vec<String>),
    Numbers(Vec<i64>),
    Variables(BTreeMap<String, String>),
}

/// The values of one table.
#[derive(Debug, Default)]
pub(super) struct Values {
    values: BTreeMap<&'static str, (Value, usize)>,
    /// Line of the table.
    pub(super) line: usize,
}

impl Values {
    pub(super) fn text(&self, key: &str) -> Option<String> {
        match &self.values.get(key)?.0 {
            Value::Text(text) => Some(text.clone()),
            Value::Truth(_)
            | Value::Number(_)
            | Value::Texts(_)
            | Value::Numbers(_)
            | Value::Variables(_) => None,
        }
    }

    pub(super) fn truth(&self, key: &str) -> Option<bool> {
        if let Value::Truth(truth) = self.values.get(key)?.0 { Some(truth) } else { None }
    }

    pub(super) fn number(&self, key: &str) -> Option<i64> {
        if let Value::Number(number) = self.values.get(key)?.0 { Some(number) } else { None }
    }

    pub(super) fn texts(&self, key: &str) -> Option<Vec<String>> {
        if let Value::Texts(texts) = &self.values.get(key)?.0 { Some(texts.clone()) } else { None }
    }

    pub(super) fn numbers(&self, key: &str) -> Option<Vec<i64>> {
        if let Value::Numbers(numbers) = &self.values.get(key)?.0 { Some(numbers.clone()) } else { None }
    }

    pub(super) fn variables(&self, key: &str) -> Option<BTreeMap<String, String>> {
        if let Value::Variables(all) = &self.values.get(key)?.0 { Some(all.clone()) } else { None }
    }

    /// Returns the line of a key, or that of its table if it is missing.
    pub(super) fn line_of(&self, key: &str) -> usize {
        self.values.get(key).map_or(self.line, |(_, line)| *line)
    }
}

/// The tables of a file, and the faults so far.
#[derive(Debug, Default)]
pub(super) struct Tables {
    pub(super) robot: Values,
    pub(super) hosts: BTreeMap<String, Values>,
    pub(super) nodes: BTreeMap<String, Values>,
    pub(super) faults: Vec<ConfigFault>,
}

impl Tables {
    /// Sorts the values of a file into its tables.
    pub(super) fn read(text: &str, table: &DeTable<'_>) -> Self {
        let mut tables = Self::default();
        for (name, value) in table {
            let line = line_of(text, &name.span());
            let known = Table::ALL.into_iter().find(|table| table.name() == name.get_ref());
            match (known, value.get_ref()) {
                (Some(Table::Robot), DeValue::Table(inner)) => {
                    tables.robot = tables.values(text, "robot", (Table::Robot, line), inner);
                }
                (Some(table), DeValue::Table(inner)) => tables.add_named(text, table, inner),
                (Some(table), _) => {
                    let form = if table == Table::Robot { "[robot]" } else { "[node.knee] or [host.knee]" };
                    let remedy = "write it on a line of its own and its keys below";
                    let found = shown(text, value.span());
                    tables.add(line, fault(name.get_ref(), found, format!("a table as {form}"), remedy));
                }
                (None, _) => tables.unknown(line, name.get_ref(), Table::ALL.map(Table::name).into_iter()),
            }
        }
        for (table, count, max) in
            [("host", tables.hosts.len(), HOSTS_MAX), ("node", tables.nodes.len(), NODES_MAX)]
        {
            if count > max {
                let found = format!("{count} tables");
                tables
                    .add(1, fault(table, found, format!("at most {max}"), "divide the robot into two files"));
            }
        }
        tables
    }

    /// Adds a fault at a line.
    pub(super) fn add(&mut self, line: usize, fault: ConfigFault) {
        self.faults.push(ConfigFault { line: Some(line), ..fault });
    }

    fn unknown(&mut self, line: usize, key: &str, known: impl Iterator<Item = &'static str>) {
        let leaf = key.rsplit('.').next().unwrap_or(key);
        let near = nearest(leaf, known, |known| known);
        let remedy = near.first().map_or_else(
            || "remove it".to_owned(),
            |nearest| format!("write {nearest}, the nearest one, or remove it"),
        );
        let legal = "a key of docs/book/src/reference/robot.md";
        self.add(line, fault(key, "a key that does not exist".to_owned(), legal, remedy));
    }

    /// Reads the tables of hosts or nodes, each with a name.
    fn add_named(&mut self, text: &str, table: Table, named: &DeTable<'_>) {
        for (name, value) in named {
            let (line, full) = (line_of(text, &name.span()), format!("{}.{}", table.name(), name.get_ref()));
            let DeValue::Table(inner) = value.get_ref() else {
                let example = format!("[{}.knee]", table.name());
                let (legal, remedy) =
                    (format!("a table as {example}"), format!("write {example} above its keys"));
                self.add(line, fault(&full, shown(text, value.span()), legal, remedy));
                continue;
            };
            let is_this_host = table == Table::Host && name.get_ref() == HERE;
            let checked = if is_this_host { Ok(()) } else { check_node_name(name.get_ref()) };
            if let Err(why) = checked {
                let remedy = "write a name as in knee";
                self.add(line, fault(&full, quoted(name.get_ref()), format!("a name: {why}"), remedy));
                continue;
            }
            let values = self.values(text, &full, (table, line), inner);
            let all = if table == Table::Host { &mut self.hosts } else { &mut self.nodes };
            all.insert(name.get_ref().to_string(), values);
        }
    }

    fn values(
        &mut self,
        text: &str,
        full: &str,
        (table, line): (Table, usize),
        inner: &DeTable<'_>,
    ) -> Values {
        let mut values = Values { values: BTreeMap::new(), line };
        let rows = || ROWS.iter().filter(|row| row.table == table);
        for (name, value) in inner {
            let (line, key) = (line_of(text, &name.span()), format!("{full}.{}", name.get_ref()));
            let Some(row) = rows().find(|row| row.key == name.get_ref()) else {
                self.unknown(line, &key, rows().map(|row| row.key));
                continue;
            };
            match read(row.kind, value.get_ref()) {
                Some(read) => _ = values.values.insert(row.key, (read, line)),
                None => self.add(line, refused(&key, row, shown(text, value.span()))),
            }
        }
        for row in rows().filter(|row| row.default.is_empty() && !inner.contains_key(row.key)) {
            // This host is no destination of ssh.
            if full != "host.here" {
                self.add(line, refused(&format!("{full}.{}", row.key), row, "nothing".to_owned()));
            }
        }
        values
    }
}

/// Returns the fault of a value that is not legal.
fn refused(key: &str, row: &Row, found: String) -> ConfigFault {
    fault(key, found, row.kind.legal(), format!("set {key} as in {}", row.kind.example()))
}

/// Reads a value of this type, if it is a legal one.
fn read(kind: Kind, value: &DeValue<'_>) -> Option<Value> {
    let is_text =
        |text: &str, max: usize| (1..=max).contains(&text.len()) && !text.chars().any(char::is_control);
    let text = |value: &DeValue<'_>, max| value.as_str().filter(|text| is_text(text, max)).map(str::to_owned);
    let name =
        |value: &DeValue<'_>| value.as_str().filter(|name| check_node_name(name).is_ok()).map(str::to_owned);
    let list = |max: usize| value.as_array().filter(|list| list.len() <= max);
    match kind {
        Kind::Name => name(value).map(Value::Text),
        Kind::Text(max) => text(value, max).map(Value::Text),
        Kind::Truth => value.as_bool().map(Value::Truth),
        Kind::Number(low, high, _) => number(value, (low, high)).map(Value::Number),
        Kind::Texts(max) => {
            let texts = list(max)?.iter().map(|item| text(item.get_ref(), TEXT_BYTES_MAX));
            texts.collect::<Option<_>>().map(Value::Texts)
        }
        Kind::Names(max) => {
            let names = list(max)?.iter().map(|item| text(item.get_ref(), NAME_BYTES_MAX));
            names.collect::<Option<_>>().map(Value::Texts)
        }
        Kind::Numbers(max, low, high) => {
            let numbers = list(max)?.iter().map(|item| number(item.get_ref(), (low, high)));
            numbers.collect::<Option<_>>().map(Value::Numbers)
        }
        Kind::Variables(max) => {
            let table = value.as_table().filter(|table| table.len() <= max)?;
            let variable = |(name, value): (&Spanned<DeString<'_>>, &Spanned<DeValue<'_>>)| {
                let is_name = is_text(name.get_ref(), TEXT_BYTES_MAX) && !name.get_ref().contains('=');
                let text = value.get_ref().as_str().filter(|text| text.len() <= TEXT_BYTES_MAX);
                let text = text.filter(|text| !text.contains('\0'))?;
                is_name.then(|| (name.get_ref().to_string(), text.to_owned()))
            };
            table.iter().map(variable).collect::<Option<_>>().map(Value::Variables)
        }
    }
}

fn number(value: &DeValue<'_>, (low, high): (i64, i64)) -> Option<i64> {
    let number = value.as_integer()?;
    let number = i64::from_str_radix(number.as_str(), number.radix()).ok()?;
    (low..=high).contains(&number).then_some(number)
}
