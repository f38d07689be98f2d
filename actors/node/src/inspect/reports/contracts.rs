//! How the report of contracts gets shorter. Its fields are in `sinew-model`, beside the check that reads them.

use sinew_model::contracts::ContractsReport;

use super::{Report, Shortened};

impl Report for ContractsReport {
    /// Halves the longer list, in bytes, so that no list displaces the other one.
    fn halve(&mut self) -> bool {
        let mut lists: [&mut dyn Shortened; 2] = [
            &mut (&mut self.contracts, &mut self.contracts_left_out),
            &mut (&mut self.outputs, &mut self.outputs_left_out),
        ];
        lists.iter_mut().max_by_key(|list| list.bytes()).is_some_and(|list| list.halve())
    }
}
