//! AdamW (Loshchilov & Hutter, 2019) with its state in the open, so that a checkpoint can hold it.
//! Without weight decay it is Adam (Kingma & Ba, 2015), which the paper uses.

use super::gradients::Gradients;
use super::model::{Group, Variable};
use candle_core::{Result, Tensor, Var};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// One trainable tensor with its running moments.
pub(super) struct Slot {
    pub(super) name: String,
    pub(super) variable: Var,
    pub(super) group: Group,
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
    /// Share of every weight that is taken away in a step, by the learning rate.
    weight_decay: f64,
}

impl Adam {
    /// Starts with moments of zero.
    pub(super) fn new(variables: Vec<Variable>, weight_decay: f64) -> Result<Self> {
        let slot = |variable: Variable| {
            let zeros = variable.variable.zeros_like()?;
            Ok(Slot {
                name: variable.name,
                variable: variable.variable,
                group: variable.group,
                first: zeros.clone(),
                second: zeros,
            })
        };
        Ok(Self {
            slots: variables.into_iter().map(slot).collect::<Result<_>>()?,
            steps: 0,
            weight_decay,
        })
    }

    /// Moves every variable that has a gradient, by the learning rate of its group.
    pub(super) fn step(
        &mut self,
        gradients: &Gradients,
        rate: impl Fn(Group) -> f64,
    ) -> Result<()> {
        self.steps += 1;
        let correction1 = 1.0 - BETA1.powf(self.steps as f64);
        let correction2 = 1.0 - BETA2.powf(self.steps as f64);
        for slot in &mut self.slots {
            let Some(gradient) = gradients.get(&slot.name) else {
                continue;
            };
            let rate = rate(slot.group);
            slot.first = ((&slot.first * BETA1)? + (gradient * (1.0 - BETA1))?)?;
            slot.second = ((&slot.second * BETA2)? + (gradient.sqr()? * (1.0 - BETA2))?)?;
            let scale = ((&slot.second / correction2)?.sqrt()? + EPSILON)?;
            let change = ((&slot.first / correction1)? / scale)?;
            // Detached: what remembered its graph would keep every past step alive.
            let weights = slot.variable.as_detached_tensor();
            let decayed = if self.weight_decay > 0.0 {
                (weights * (1.0 - rate * self.weight_decay))?
            } else {
                weights
            };
            slot.variable.set(&(decayed - (change * rate)?)?)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
