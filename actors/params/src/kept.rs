//! Kept parameters: their values before the start of a node and after it.

use crate::{
    NamedValue, ParameterError, Parameters,
    tuner::{legal_bits, unknown},
};

/// Returns the kept parameters of a set, with the values to which they move after a restart: those to which they move
/// now, or those of a transaction that is agreed on. Any thread may call it.
#[must_use]
pub fn kept_values(set: &dyn Parameters) -> Vec<NamedValue> {
    let kept = set.descriptors().iter().enumerate().filter(|(_, descriptor)| descriptor.keep);
    let values = kept.filter_map(|(index, descriptor)| {
        let value = descriptor.value_of(set.cell(index)?.kept());
        Some(NamedValue { name: descriptor.name.to_owned(), value })
    });
    values.collect()
}

/// Gives kept parameters these values, before their application starts. Returns the reasons why some were left out.
#[must_use]
pub fn restore(set: &dyn Parameters, values: &[NamedValue]) -> Vec<ParameterError> {
    let restore_one = |NamedValue { name, value }: &NamedValue| {
        let descriptors = set.descriptors();
        let index = descriptors.iter().position(|one| one.keep && one.name == name);
        let index = index.ok_or_else(|| unknown(name, descriptors))?;
        let bits = legal_bits(&descriptors[index], *value)?;
        if let Some(cell) = set.cell(index) {
            cell.set_value(bits);
            cell.set_target(bits);
        }
        Ok(())
    };
    values.iter().filter_map(|one| restore_one(one).err()).collect()
}
