//! The vocabulary of a street: what its houses have in common, and what each one is.
//!
//! Streets draw their styles from one small stock and their houses from one street's style, so that
//! neighbours, and whole streets, look alike at a glance and differ in their details.

use super::random::Dice;

/// What a wall is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Material {
    Brick,
    Plaster,
    Stone,
    Timber,
    Panel,
}

/// The shape of a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum WindowKind {
    /// One pane.
    Plain,
    /// A cross of glazing bars.
    Cross,
    /// Six small panes over one.
    Sash,
    /// A round arch above.
    Arched,
    /// A band nearly as wide as its bay.
    Band,
}

/// What houses of a street share.
#[derive(Debug, Clone)]
pub(super) struct StreetStyle {
    materials: Vec<Material>,
    walls: Vec<[u8; 3]>,
    windows: Vec<WindowKind>,
    floors: [usize; 2],
    pub half_width: f32,
    pub pavement_width: f32,
    pub trees: bool,
    pub cobbles: bool,
}

/// One house front.
#[derive(Debug, Clone)]
pub(super) struct HouseStyle {
    pub material: Material,
    pub wall: [u8; 3],
    pub trim: [u8; 3],
    pub accent: [u8; 3],
    pub roof: [u8; 3],
    pub window: WindowKind,
    pub floors: usize,
    pub floor_height: f32,
    pub ground_height: f32,
    pub shop: bool,
    pub balconies: bool,
    pub shutters: bool,
    pub cornice: bool,
    pub pitched: bool,
}

const WARM_WALLS: [[u8; 3]; 7] = [
    [214, 196, 160],
    [226, 211, 184],
    [205, 170, 130],
    [190, 150, 122],
    [222, 200, 140],
    [201, 181, 165],
    [180, 120, 92],
];
const COOL_WALLS: [[u8; 3]; 6] = [
    [188, 194, 198],
    [170, 182, 186],
    [206, 208, 204],
    [150, 164, 172],
    [196, 204, 190],
    [176, 170, 182],
];
const BRICKS: [[u8; 3]; 5] = [
    [150, 78, 60],
    [134, 66, 54],
    [168, 98, 70],
    [120, 84, 70],
    [176, 130, 96],
];
const ACCENTS: [[u8; 3]; 9] = [
    [168, 40, 44],
    [30, 84, 120],
    [36, 104, 70],
    [196, 140, 36],
    [92, 50, 110],
    [40, 44, 52],
    [20, 120, 130],
    [210, 96, 40],
    [120, 60, 40],
];

impl StreetStyle {
    pub(super) fn new(dice: &mut Dice) -> Self {
        let (materials, walls, windows) = match dice.whole(0..4) {
            0 => (
                vec![Material::Brick, Material::Brick, Material::Stone],
                BRICKS.to_vec(),
                vec![WindowKind::Sash],
            ),
            1 => (
                vec![Material::Plaster],
                WARM_WALLS.to_vec(),
                vec![WindowKind::Cross, WindowKind::Arched],
            ),
            2 => (
                vec![Material::Plaster, Material::Timber],
                WARM_WALLS.to_vec(),
                vec![WindowKind::Cross],
            ),
            _ => (
                vec![Material::Panel, Material::Plaster],
                COOL_WALLS.to_vec(),
                vec![WindowKind::Band, WindowKind::Plain],
            ),
        };
        let low = dice.whole(2..4);
        Self {
            materials,
            walls,
            windows,
            floors: [low, low + 3],
            half_width: dice.real(7.5..10.5),
            pavement_width: dice.real(2.0..3.2),
            trees: dice.chance(0.65),
            cobbles: dice.chance(0.3),
        }
    }

    pub(super) fn house(&self, dice: &mut Dice) -> HouseStyle {
        let material = dice.pick(&self.materials);
        let base = if material == Material::Brick {
            dice.pick(&BRICKS)
        } else {
            dice.pick(&self.walls)
        };
        let window = if dice.chance(0.8) {
            dice.pick(&self.windows)
        } else {
            WindowKind::Plain
        };
        HouseStyle {
            material,
            wall: dice.vary(base, 7.0),
            trim: dice.pick(&[
                [236, 232, 222],
                [222, 214, 200],
                [90, 84, 80],
                [240, 240, 238],
                [120, 100, 84],
            ]),
            accent: dice.pick(&ACCENTS),
            roof: dice.pick(&[[128, 66, 52], [92, 88, 90], [110, 78, 66], [70, 74, 80]]),
            window,
            floors: dice.whole(self.floors[0]..self.floors[1]),
            floor_height: dice.real(2.8..3.4),
            ground_height: dice.real(3.4..4.2),
            shop: dice.chance(0.5),
            balconies: dice.chance(0.3),
            shutters: matches!(window, WindowKind::Cross | WindowKind::Plain) && dice.chance(0.4),
            cornice: dice.chance(0.7),
            pitched: dice.chance(0.7),
        }
    }
}

impl HouseStyle {
    /// Height of the front in metres.
    pub(super) fn height(&self) -> f32 {
        self.ground_height + self.floors as f32 * self.floor_height + 0.7
    }
}
