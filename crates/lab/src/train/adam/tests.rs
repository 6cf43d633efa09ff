//! The optimiser against values computed independently.

use super::*;
use crate::train::loss::{normalise_rows, triplet_margin_loss};
use candle_core::Device;
use serde::Deserialize;

/// Made by `tests/fixtures/train/make_triplet_step.py` with PyTorch.
#[derive(Deserialize)]
struct Fixture {
    margin: f64,
    rate: f64,
    query: Vec<Vec<f32>>,
    positive: Vec<Vec<f32>>,
    negative: Vec<Vec<f32>>,
    weight: Vec<Vec<f32>>,
    bias: Vec<f32>,
    steps: Vec<Step>,
}

#[derive(Deserialize)]
struct Step {
    loss: f32,
    weight_gradient: Vec<Vec<f32>>,
    weight: Vec<Vec<f32>>,
    bias: Vec<f32>,
}

fn matrix(rows: &[Vec<f32>]) -> Tensor {
    Tensor::from_vec(rows.concat(), (rows.len(), rows[0].len()), &Device::Cpu).unwrap()
}

fn assert_near(what: &str, actual: &Tensor, expected: &[f32], tolerance: f32) {
    let actual = actual.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let worst = actual
        .iter()
        .zip(expected)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    assert!(
        actual.len() == expected.len() && worst < tolerance,
        "{what}: off by {worst}"
    );
}

#[test]
fn loss_gradient_and_steps_are_those_of_pytorch() {
    let fixture: Fixture = serde_json::from_str(include_str!(
        "../../../../../tests/fixtures/train/triplet_step.json"
    ))
    .unwrap();
    let weight = Var::from_tensor(&matrix(&fixture.weight)).unwrap();
    let bias =
        Var::from_tensor(&Tensor::new(fixture.bias.as_slice(), &Device::Cpu).unwrap()).unwrap();
    let variables = || {
        [("weight", &weight), ("bias", &bias)]
            .map(|(name, variable)| Variable {
                name: name.into(),
                variable: variable.clone(),
                group: Group::Projection,
            })
            .into()
    };
    let mut adam = Adam::new(variables(), 0.0).unwrap();
    for step in &fixture.steps {
        let embed = |rows: &[Vec<f32>]| {
            let projected = matrix(rows)
                .matmul(&weight.t().unwrap())
                .unwrap()
                .broadcast_add(&bias)
                .unwrap();
            normalise_rows(&projected).unwrap()
        };
        let query = embed(&fixture.query);
        let positive = embed(&fixture.positive);
        let negative = embed(&fixture.negative);
        let loss = triplet_margin_loss(&query, &positive, &negative, fixture.margin).unwrap();
        assert!((loss.to_scalar::<f32>().unwrap() - step.loss).abs() < 1e-6);
        let gradients = loss.backward().unwrap();
        assert_near(
            "gradient",
            gradients.get(&weight).unwrap(),
            &step.weight_gradient.concat(),
            1e-6,
        );
        let gradients = Gradients::of(&gradients, &variables());
        adam.step(&gradients, |_| fixture.rate).unwrap();
        assert_near("weight", &weight, &step.weight.concat(), 1e-6);
        assert_near("bias", &bias, &step.bias, 1e-6);
    }
}

#[test]
fn groups_have_rates_of_their_own_and_weights_decay_by_them() {
    let value = |value: f32| Var::from_tensor(&Tensor::new(&[value], &Device::Cpu).unwrap());
    let variable = |name: &str, group: Group, start: f32| Variable {
        name: name.into(),
        variable: value(start).unwrap(),
        group,
    };
    let variables = || {
        vec![
            variable("slow", Group::Blocks, 2.0),
            variable("fast", Group::Aggregate, 2.0),
            variable("unused", Group::Projection, 2.0),
        ]
    };
    let kept = variables();
    let loss = (kept[0].variable.as_tensor() + kept[1].variable.as_tensor()).unwrap();
    let store = loss.sum_all().unwrap().backward().unwrap();
    let gradients = Gradients::of(&store, &kept);
    let mut adam = Adam::new(kept, 0.5).unwrap();
    let rate = |group: Group| match group {
        Group::Blocks => 0.01,
        Group::Aggregate | Group::Projection => 0.1,
    };
    adam.step(&gradients, rate).unwrap();
    let now: Vec<f32> = adam
        .slots
        .iter()
        .map(|slot| slot.variable.to_vec1::<f32>().unwrap()[0])
        .collect();
    // The first step of Adam is the rate whatever the gradient; a weight of 2 loses half of its
    // rate times 2.
    for (now, expected) in now.iter().zip([2.0 - 0.01 - 0.01, 2.0 - 0.1 - 0.1, 2.0]) {
        assert!((now - expected).abs() < 1e-5, "{now} {expected}");
    }
}
