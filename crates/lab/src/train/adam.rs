//! Adam (Kingma & Ba, 2015) with its state in the open, so that a checkpoint can hold it.

use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor, Var};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// One trainable tensor with its running moments.
pub(super) struct Slot {
    pub(super) name: String,
    pub(super) variable: Var,
    /// Mean of the gradients.
    pub(super) first: Tensor,
    /// Mean of their squares.
    pub(super) second: Tensor,
}

/// The optimiser.
pub(super) struct Adam {
    pub(super) slots: Vec<Slot>,
    /// Steps taken.
    pub(super) steps: u64,
}

impl Adam {
    /// Starts with moments of zero.
    pub(super) fn new(variables: Vec<(String, Var)>) -> Result<Self> {
        let slots = variables
            .into_iter()
            .map(|(name, variable)| {
                let zeros = variable.zeros_like()?;
                Ok(Slot {
                    name,
                    variable,
                    first: zeros.clone(),
                    second: zeros,
                })
            })
            .collect::<Result<_>>()?;
        Ok(Self { slots, steps: 0 })
    }

    /// Moves every variable that has a gradient.
    pub(super) fn step(&mut self, gradients: &GradStore, rate: f64) -> Result<()> {
        self.steps += 1;
        let correction1 = 1.0 - BETA1.powf(self.steps as f64);
        let correction2 = 1.0 - BETA2.powf(self.steps as f64);
        for slot in &mut self.slots {
            let Some(gradient) = gradients.get(slot.variable.as_tensor()) else {
                continue;
            };
            // Detached: a moment that remembered its graph would keep every past step alive.
            let gradient = gradient.detach();
            slot.first = ((&slot.first * BETA1)? + (&gradient * (1.0 - BETA1))?)?.detach();
            slot.second = ((&slot.second * BETA2)? + (gradient.sqr()? * (1.0 - BETA2))?)?.detach();
            let scale = ((&slot.second / correction2)?.sqrt()? + EPSILON)?;
            let change = ((&slot.first / correction1)? / scale)?;
            slot.variable
                .set(&(slot.variable.as_tensor() - (change * rate)?)?.detach())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
