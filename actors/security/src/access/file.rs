//! Reads a list from TOML. Reports all faults at once, each with its line, the legal values and the remedy.

use std::{borrow::Cow, path::Path};

use sinew_model::config::{ConfigError, ConfigFault, fault, line_of, quoted, shown, syntax_fault};
use sinew_runtime::{
    name::{check_name, is_invisible},
    tid::AppAddress,
    wire::Class,
};
use toml::{
    Spanned,
    de::{DeTable, DeValue},
};

use super::{
    client::{CLIENTS_MAX, ClientRule, Joinable},
    rule::{Action, Classes, List, PATTERNS_MAX, RULES_MAX, Roles, Rule, TEXTS_MAX},
    selector::{self, Selector},
};
use crate::files::{self, KeyFileError};

/// Keys of a `[[rule]]`, and of a `[[client]]`.
const RULE_KEYS: [&str; 6] = ["name", "from", "to", "groups", "classes", "action"];
const CLIENT_KEYS: [&str; 5] = ["uid", "gid", "names", "addresses", "groups"];
/// Keys of `[roles]`.
const ROLE_KEYS: [&str; 2] = ["operators", "observers"];
/// Maximum file size in bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// Maximum length of a rule name in bytes.
const RULE_NAME_MAX: usize = 63;

/// Reads the list in the file at `path`, of at most 1 MiB.
///
/// # Errors
/// Returns all faults of the list. A file that cannot be read is one fault.
pub fn read(path: &Path) -> Result<List, ConfigError> {
    let read = files::access_list(path, FILE_BYTES_MAX).map_err(|why| match why {
        KeyFileError::Unreadable { cause, .. } => cause.to_string(),
        KeyFileError::Other { .. } => "no file".to_owned(),
        KeyFileError::TooLong { .. } => "a longer file".to_owned(),
        why @ (KeyFileError::ForeignOwner { .. }
        | KeyFileError::Exposed { .. }
        | KeyFileError::Writable { .. }) => why.to_string(),
    });
    let text = read.and_then(|bytes| String::from_utf8(bytes.to_vec()).map_err(|error| error.to_string()));
    let text = text.map_err(|found| {
        let legal =
            "a text file of at most 1 MiB that this user may read, and that only it or root may write to, in a directory of which the same is so";
        let remedy = "check security.access, the path and its permissions, and those of its directory";
        ConfigError::one(fault(&path.display().to_string(), found, legal, remedy))
    })?;
    parse(&text).map_err(|faults| faults.of_file(path))
}

/// Parses `text` as a list.
///
/// # Errors
/// Returns all faults of the list.
pub(super) fn parse(text: &str) -> Result<List, ConfigError> {
    let table = DeTable::parse(text).map_err(|error| ConfigError::one(syntax_fault(text, &error)))?;
    let mut reader = Reader { text, faults: Vec::new() };
    let mut list = List::default();
    for (name, value) in table.get_ref() {
        match &**name.get_ref() {
            "rule" => list.rules = reader.tables(value, ("rule", RULES_MAX), Reader::rule),
            "client" => list.clients = reader.tables(value, ("client", CLIENTS_MAX), Reader::client),
            "roles" => list.roles = reader.roles(value),
            other => {
                let found = "a key that does not exist".to_owned();
                let remedy = "write [[rule]], [[client]] or [roles] and their keys below";
                reader.add(other, name, Some(found), ("[[rule]], [[client]] and [roles]", remedy));
            }
        }
    }
    let patterns: usize = list.rules.iter().map(|rule| rule.from.len() + rule.to.len()).sum();
    if patterns > PATTERNS_MAX {
        let legal = format!("at most {PATTERNS_MAX} texts in `from` and `to` of all rules together");
        let remedy = "put several into a pattern or a range";
        reader.faults.push(fault("rule", format!("{patterns} of them"), &legal, remedy));
    }
    reader.faults.sort_by_key(|fault| fault.line);
    ConfigError::check(reader.faults)?;
    Ok(list)
}

/// A text and the faults found in it so far.
struct Reader<'t> {
    text: &'t str,
    faults: Vec<ConfigFault>,
}

type Value<'t> = Spanned<DeValue<'t>>;
type Table<'t> = DeTable<'t>;

impl<'t> Reader<'t> {
    fn add<S>(
        &mut self,
        key: &str,
        place: &Spanned<S>,
        found: Option<String>,
        (legal, remedy): (&str, &str),
    ) {
        let found = found.unwrap_or_else(|| shown(self.text, place.span()));
        let line = Some(line_of(self.text, &place.span()));
        let key = quoted(key).trim_matches('"').to_owned();
        self.faults.push(ConfigFault { line, ..fault(&key, found, legal, remedy) });
    }

    /// Reads the tables of an array with `one`, which reports the faults of its table itself.
    fn tables<T>(
        &mut self,
        value: &Value<'t>,
        (key, max): (&'static str, usize),
        one: fn(&mut Self, &Value<'t>, &Table<'t>) -> Option<T>,
    ) -> Vec<T> {
        let legal = format!("at most {max} tables, each with [[{key}]] above it");
        let remedy = format!("write [[{key}]] on a line of its own and its keys below");
        let Some(tables) = value.get_ref().as_array() else {
            self.add(key, value, None, (&legal, &remedy));
            return Vec::new();
        };
        if tables.len() > max {
            self.add(key, value, Some(format!("{} of them", tables.len())), (&legal, "put several into one"));
        }
        let mut read = Vec::new();
        for table in tables.iter().take(max) {
            match table.get_ref().as_table() {
                Some(keys) => read.extend(one(self, table, keys)),
                None => self.add(key, table, None, (&legal, &remedy)),
            }
        }
        read
    }

    fn rule(&mut self, place: &Value<'t>, table: &Table<'t>) -> Option<Rule> {
        self.check_keys(table, "rule", &RULE_KEYS);
        let name = self.optional(table, "rule.name", |value| {
            let name = value.as_str().filter(|name| (1..=RULE_NAME_MAX).contains(&name.len()))?;
            (!name.contains(is_invisible)).then(|| name.to_owned())
        });
        let action = self.optional(table, "rule.action", |value| match value.as_str()? {
            "allow" => Some(Action::Allow),
            "refuse" => Some(Action::Refuse),
            _ => None,
        });
        let from = self.texts(table, "rule.from", selector::LEGAL, Selector::parse);
        let to = self.texts(table, "rule.to", selector::LEGAL, Selector::parse);
        let groups = self.texts(table, "rule.groups", GROUP_LEGAL, group);
        let classes = self.texts(table, "rule.classes", CLASS_LEGAL, class);
        if from.is_none() {
            let remedy = "say from whom, or from = [\"*\"] for everybody";
            self.add("rule.from", place, Some("nothing".to_owned()), (selector::LEGAL, remedy));
        }
        if to.is_none() && groups.is_none() {
            let remedy = "say to whom: to = [\"*\"] for every application, or groups";
            self.add("rule.to", place, Some("nothing".to_owned()), (selector::LEGAL, remedy));
        }
        Some(Rule {
            name,
            line: line_of(self.text, &place.span()),
            action: action.unwrap_or(Action::Allow),
            from: from?,
            to: to.unwrap_or_default(),
            groups: groups.unwrap_or_default(),
            classes: classes.map_or(Classes::ALL, Classes::of),
        })
    }

    fn client(&mut self, place: &Value<'t>, table: &Table<'t>) -> Option<ClientRule> {
        self.check_keys(table, "client", &CLIENT_KEYS);
        let number = |value: &DeValue<'t>| {
            let number = value.as_integer()?;
            u32::from_str_radix(number.as_str(), number.radix()).ok()
        };
        let uid = self.optional(table, "client.uid", number);
        let gid = self.optional(table, "client.gid", number);
        if !table.contains_key("uid") && !table.contains_key("gid") {
            let legal = "the number of a user (uid) or of a group (gid), or both";
            self.add(
                "client.uid",
                place,
                Some("neither".to_owned()),
                (legal, "say whom it is about (see `id`)"),
            );
        }
        let legal = "names of 1 to 63 bytes; `*` stands for any text";
        let names = self.texts(table, "client.names", legal, selector::name_pattern).unwrap_or_default();
        let legal = "addresses as in \"1001\" or \"1000-10ff\", or \"*\"";
        let addresses = self.texts(table, "client.addresses", legal, selector::range).unwrap_or_default();
        let groups = self.texts(table, "client.groups", JOINABLE_LEGAL, joinable);
        Some(ClientRule { line: line_of(self.text, &place.span()), uid, gid, names, addresses, groups })
    }

    fn roles(&mut self, value: &Value<'t>) -> Roles {
        let Some(table) = value.get_ref().as_table() else {
            let remedy = "write [roles] on a line of its own and its keys below";
            self.add("roles", value, None, ("a table, [roles]", remedy));
            return Roles::default();
        };
        self.check_keys(table, "roles", &ROLE_KEYS);
        let mut of = |key| self.texts(table, key, selector::LEGAL, Selector::parse).unwrap_or_default();
        Roles { operators: of("roles.operators"), observers: of("roles.observers") }
    }

    fn check_keys(&mut self, table: &Table<'t>, of: &str, keys: &[&str]) {
        for (name, _) in table.iter().filter(|(name, _)| !keys.contains(&&**name.get_ref())) {
            let key = format!("{of}.{}", name.get_ref());
            let legal = format!("one of {}", keys.join(", "));
            let found = "a key that does not exist".to_owned();
            self.add(&key, name, Some(found), (&legal, "is it spelled right? Else remove it"));
        }
    }

    /// Reads an optional value.
    fn optional<T>(
        &mut self,
        table: &Table<'t>,
        key: &'static str,
        read: impl Fn(&DeValue<'t>) -> Option<T>,
    ) -> Option<T> {
        let value = table.get(leaf(key))?;
        let found = read(value.get_ref());
        if found.is_none() {
            let legal = match key {
                "rule.action" => "\"allow\" or \"refuse\"",
                "rule.name" => "a text of 1 to 63 bytes without invisible characters",
                _ => "a number from 0 to 4294967295",
            };
            self.add(
                key,
                value,
                None,
                (legal, &format!("set {} to what is legal, or leave it out", leaf(key))),
            );
        }
        found
    }

    /// Reads an optional list of texts, each with `read`. Returns `None` if the key is absent. An empty list is a
    /// fault.
    fn texts<T, E: Into<Cow<'static, str>>>(
        &mut self,
        table: &Table<'t>,
        key: &'static str,
        legal: &str,
        read: impl Fn(&str) -> Result<T, E>,
    ) -> Option<Vec<T>> {
        let value = table.get(leaf(key))?;
        let legal = format!("a list of 1 to {TEXTS_MAX} texts: {legal}");
        let texts = value.get_ref().as_array().filter(|texts| (1..=TEXTS_MAX).contains(&texts.len()));
        let Some(texts) = texts else {
            self.add(key, value, None, (&legal, &format!("write {} = [\"...\"]", leaf(key))));
            return Some(Vec::new());
        };
        let mut all = Vec::new();
        for text in texts {
            match text.get_ref().as_str().map(&read) {
                Some(Ok(one)) => all.push(one),
                Some(Err(remedy)) => self.add(key, text, None, (&legal, &remedy.into())),
                None => self.add(key, text, None, (&legal, "write it as a text, in quotes")),
            }
        }
        Some(all)
    }
}

const GROUP_LEGAL: &str = "names of groups";
const JOINABLE_LEGAL: &str = "names of groups, or \"*\" for every one";
const CLASS_LEGAL: &str = "\"control\", \"stream\" or \"bulk\"";

fn leaf(key: &str) -> &str {
    key.split_once('.').map_or(key, |(_, leaf)| leaf)
}

fn group(text: &str) -> Result<AppAddress, Cow<'static, str>> {
    if text.contains('*') {
        // A group is transmitted as a number made from its name.
        return Err(
            "name each group: a pattern cannot be compared with what travels, which is a number made of the name".into(),
        );
    }
    check_name(text).map_err(|why| why.to_string())?;
    Ok(AppAddress::group(text))
}

fn joinable(text: &str) -> Result<Joinable, Cow<'static, str>> {
    if text == "*" { Ok(Joinable::Any) } else { group(text).map(Joinable::One) }
}

fn class(text: &str) -> Result<Class, &'static str> {
    match text {
        "control" => Ok(Class::Control),
        "stream" => Ok(Class::Stream),
        "bulk" => Ok(Class::Bulk),
        _ => Err("write control, stream or bulk"),
    }
}
