"""Label numbers of public data sets as :class:`~sst_graph.types.SemanticClass`, each list with its source.

The canonical classes are chosen so that the two sensors' conventions agree: SemanticKITTI's "bicyclist"
holds the person and the bicycle, hence Cityscapes' rider counts as TWO_WHEELER; its "fence" holds small
walls and barriers; its "vegetation" is mapped together with trunks, as in Cityscapes. What one data set calls
by a name that may be either of two classes (the walls of COCO and ADE20K) is IGNORE.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from sst_graph.types import SemanticClass

_C = SemanticClass
_IGNORED = 255
"""The number of pixels without a label in 8-bit masks."""


@dataclass(frozen=True)
class ClassMap:
    """What the label numbers of a data set mean.

    Attributes:
        name: by which it is asked for.
        classes: canonical class by number.
        names: the data set's own name by number.
        source: where the numbers are published.
    """

    name: str
    classes: Mapping[int, SemanticClass]
    names: Mapping[int, str]
    source: str

    @property
    def outputs(self) -> int:
        """Outputs of a network trained on these numbers: the largest of them, 255 aside, plus 1."""
        return max(number for number in self.classes if number != _IGNORED) + 1


def _listed(name: str, source: str, entries: Iterable[tuple[int, str, SemanticClass]]) -> ClassMap:
    rows = list(entries)
    classes = {number: label for number, _, label in rows}
    names = {number: word for number, word, _ in rows}
    return ClassMap(name, MappingProxyType(classes), MappingProxyType(names), source)


def _renumbered(name: str, source: str, other: ClassMap, numbers: Iterable[int]) -> ClassMap:
    """Entries of another map, in the order of its ``numbers``, as 0, 1, ..., and 255 to be ignored."""
    rows = [(k, other.names[n], other.classes[n]) for k, n in enumerate(numbers)]
    return _listed(name, source, [*rows, (_IGNORED, "unlabeled", _C.IGNORE)])


SEMANTIC_KITTI = _listed(
    "semantickitti",
    "config/semantic-kitti.yaml of PRBonn/semantic-kitti-api (labels); low 16 bits of a label",
    (
        (0, "unlabeled", _C.IGNORE),
        (1, "outlier", _C.IGNORE),
        (10, "car", _C.VEHICLE),
        (11, "bicycle", _C.TWO_WHEELER),
        (13, "bus", _C.VEHICLE),
        (15, "motorcycle", _C.TWO_WHEELER),
        (16, "on-rails", _C.VEHICLE),
        (18, "truck", _C.VEHICLE),
        (20, "other-vehicle", _C.VEHICLE),
        (30, "person", _C.PERSON),
        (31, "bicyclist", _C.TWO_WHEELER),
        (32, "motorcyclist", _C.TWO_WHEELER),
        (40, "road", _C.GROUND),
        (44, "parking", _C.GROUND),
        (48, "sidewalk", _C.GROUND),
        (49, "other-ground", _C.GROUND),
        (50, "building", _C.BUILDING),
        (51, "fence", _C.FENCE),
        (52, "other-structure", _C.OTHER),
        (60, "lane-marking", _C.GROUND),
        (70, "vegetation", _C.VEGETATION),
        (71, "trunk", _C.VEGETATION),
        (72, "terrain", _C.TERRAIN),
        (80, "pole", _C.POLE),
        (81, "traffic-sign", _C.SIGN),
        (99, "other-object", _C.OTHER),
        (252, "moving-car", _C.VEHICLE),
        (253, "moving-bicyclist", _C.TWO_WHEELER),
        (254, "moving-person", _C.PERSON),
        (255, "moving-motorcyclist", _C.TWO_WHEELER),
        (256, "moving-on-rails", _C.VEHICLE),
        (257, "moving-bus", _C.VEHICLE),
        (258, "moving-truck", _C.VEHICLE),
        (259, "moving-other-vehicle", _C.VEHICLE),
    ),
)
"""The moving classes fold into their static ones."""

_KITTI_TRAINED = (10, 11, 15, 18, 20, 30, 31, 32, 40, 44, 48, 49, 50, 51, 70, 71, 72, 80, 81)

SEMANTIC_KITTI_20 = _listed(
    "semantickitti-20",
    "config/semantic-kitti.yaml of PRBonn/semantic-kitti-api (learning_map_inv): 0 unlabeled, 1 car ... 19",
    ((k, SEMANTIC_KITTI.names[n], SEMANTIC_KITTI.classes[n]) for k, n in enumerate((0, *_KITTI_TRAINED))),
)
SEMANTIC_KITTI_19 = _renumbered(
    "semantickitti-19",
    "as semantickitti-20 without its 0: 0 car ... 18 traffic-sign (mmdetection3d)",
    SEMANTIC_KITTI,
    _KITTI_TRAINED,
)

CITYSCAPES_IDS = _listed(
    "cityscapes-ids",
    "cityscapesscripts/helpers/labels.py of mcordts/cityscapesScripts (id)",
    (
        (0, "unlabeled", _C.OTHER),  # background
        (1, "ego vehicle", _C.IGNORE),
        (2, "rectification border", _C.IGNORE),
        (3, "out of roi", _C.IGNORE),
        (4, "static", _C.OTHER),
        (5, "dynamic", _C.OTHER),
        (6, "ground", _C.GROUND),
        (7, "road", _C.GROUND),
        (8, "sidewalk", _C.GROUND),
        (9, "parking", _C.GROUND),
        (10, "rail track", _C.GROUND),
        (11, "building", _C.BUILDING),
        (12, "wall", _C.FENCE),
        (13, "fence", _C.FENCE),
        (14, "guard rail", _C.FENCE),
        (15, "bridge", _C.OTHER),
        (16, "tunnel", _C.OTHER),
        (17, "pole", _C.POLE),
        (18, "polegroup", _C.POLE),
        (19, "traffic light", _C.OTHER),
        (20, "traffic sign", _C.SIGN),
        (21, "vegetation", _C.VEGETATION),
        (22, "terrain", _C.TERRAIN),
        (23, "sky", _C.SKY),
        (24, "person", _C.PERSON),
        (25, "rider", _C.TWO_WHEELER),
        (26, "car", _C.VEHICLE),
        (27, "truck", _C.VEHICLE),
        (28, "bus", _C.VEHICLE),
        (29, "caravan", _C.VEHICLE),
        (30, "trailer", _C.VEHICLE),
        (31, "train", _C.VEHICLE),
        (32, "motorcycle", _C.TWO_WHEELER),
        (33, "bicycle", _C.TWO_WHEELER),
        (_IGNORED, "license plate", _C.IGNORE),
    ),
)

CITYSCAPES_TRAIN_IDS = _renumbered(
    "cityscapes-trainids",
    "cityscapesscripts/helpers/labels.py of mcordts/cityscapesScripts (trainId): 0 road ... 18 bicycle",
    CITYSCAPES_IDS,
    (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33),
)

NUSCENES_LIDARSEG = _listed(
    "nuscenes-lidarseg",
    "the category table of nuScenes-lidarseg (docs/instructions_lidarseg.md of nutonomy/nuscenes-devkit)",
    (
        (0, "noise", _C.IGNORE),
        (1, "animal", _C.OTHER),
        (2, "human.pedestrian.adult", _C.PERSON),
        (3, "human.pedestrian.child", _C.PERSON),
        (4, "human.pedestrian.construction_worker", _C.PERSON),
        (5, "human.pedestrian.personal_mobility", _C.PERSON),
        (6, "human.pedestrian.police_officer", _C.PERSON),
        (7, "human.pedestrian.stroller", _C.PERSON),
        (8, "human.pedestrian.wheelchair", _C.PERSON),
        (9, "movable_object.barrier", _C.FENCE),
        (10, "movable_object.debris", _C.OTHER),
        (11, "movable_object.pushable_pullable", _C.OTHER),
        (12, "movable_object.trafficcone", _C.OTHER),
        (13, "static_object.bicycle_rack", _C.OTHER),
        (14, "vehicle.bicycle", _C.TWO_WHEELER),
        (15, "vehicle.bus.bendy", _C.VEHICLE),
        (16, "vehicle.bus.rigid", _C.VEHICLE),
        (17, "vehicle.car", _C.VEHICLE),
        (18, "vehicle.construction", _C.VEHICLE),
        (19, "vehicle.emergency.ambulance", _C.VEHICLE),
        (20, "vehicle.emergency.police", _C.VEHICLE),
        (21, "vehicle.motorcycle", _C.TWO_WHEELER),
        (22, "vehicle.trailer", _C.VEHICLE),
        (23, "vehicle.truck", _C.VEHICLE),
        (24, "flat.driveable_surface", _C.GROUND),
        (25, "flat.other", _C.GROUND),
        (26, "flat.sidewalk", _C.GROUND),
        (27, "flat.terrain", _C.TERRAIN),
        (28, "static.manmade", _C.BUILDING),  # buildings, walls, poles and signs alike
        (29, "static.other", _C.OTHER),
        (30, "static.vegetation", _C.VEGETATION),
        (31, "vehicle.ego", _C.IGNORE),
    ),
)

NUSCENES_17 = _listed(
    "nuscenes-17",
    "the lidarseg challenge (eval/lidarseg of nutonomy/nuscenes-devkit): 0 void, 1 barrier ... 16",
    (
        (0, "void", _C.IGNORE),
        (1, "barrier", _C.FENCE),
        (2, "bicycle", _C.TWO_WHEELER),
        (3, "bus", _C.VEHICLE),
        (4, "car", _C.VEHICLE),
        (5, "construction_vehicle", _C.VEHICLE),
        (6, "motorcycle", _C.TWO_WHEELER),
        (7, "pedestrian", _C.PERSON),
        (8, "traffic_cone", _C.OTHER),
        (9, "trailer", _C.VEHICLE),
        (10, "truck", _C.VEHICLE),
        (11, "driveable_surface", _C.GROUND),
        (12, "other_flat", _C.GROUND),
        (13, "sidewalk", _C.GROUND),
        (14, "terrain", _C.TERRAIN),
        (15, "manmade", _C.BUILDING),
        (16, "vegetation", _C.VEGETATION),
    ),
)
NUSCENES_16 = _renumbered(
    "nuscenes-16", "as nuscenes-17 without its 0: 0 barrier ... 15 (mmdetection3d)", NUSCENES_17, range(1, 17)
)

_COCO_CLASSES = {
    "person": _C.PERSON,
    **dict.fromkeys(("bicycle", "motorcycle"), _C.TWO_WHEELER),
    **dict.fromkeys(("car", "bus", "train", "truck"), _C.VEHICLE),
    "stop sign": _C.SIGN,
    **dict.fromkeys(("gravel", "platform", "railroad", "road", "pavement-merged"), _C.GROUND),
    **dict.fromkeys(
        ("house", "roof", "door-stuff", "window-blind", "window-other", "building-other-merged"), _C.BUILDING
    ),
    **dict.fromkeys(("flower", "tree-merged"), _C.VEGETATION),
    **dict.fromkeys(("sand", "snow", "grass-merged", "dirt-merged"), _C.TERRAIN),
    "fence-merged": _C.FENCE,
    "sky-other-merged": _C.SKY,
    **dict.fromkeys(("wall-brick", "wall-stone", "wall-tile", "wall-wood", "wall-other-merged"), _C.IGNORE),
}
_COCO_TEXT = (
    "1 person;2 bicycle;3 car;4 motorcycle;5 airplane;6 bus;7 train;8 truck;9 boat;10 traffic light;"
    "11 fire hydrant;13 stop sign;14 parking meter;15 bench;16 bird;17 cat;18 dog;19 horse;20 sheep;21 cow;"
    "22 elephant;23 bear;24 zebra;25 giraffe;27 backpack;28 umbrella;31 handbag;32 tie;33 suitcase;"
    "34 frisbee;35 skis;36 snowboard;37 sports ball;38 kite;39 baseball bat;40 baseball glove;"
    "41 skateboard;42 surfboard;43 tennis racket;44 bottle;46 wine glass;47 cup;48 fork;49 knife;50 spoon;"
    "51 bowl;52 banana;53 apple;54 sandwich;55 orange;56 broccoli;57 carrot;58 hot dog;59 pizza;60 donut;"
    "61 cake;62 chair;63 couch;64 potted plant;65 bed;67 dining table;70 toilet;72 tv;73 laptop;74 mouse;"
    "75 remote;76 keyboard;77 cell phone;78 microwave;79 oven;80 toaster;81 sink;82 refrigerator;84 book;"
    "85 clock;86 vase;87 scissors;88 teddy bear;89 hair drier;90 toothbrush;92 banner;93 blanket;95 bridge;"
    "100 cardboard;107 counter;109 curtain;112 door-stuff;118 floor-wood;119 flower;122 fruit;125 gravel;"
    "128 house;130 light;133 mirror-stuff;138 net;141 pillow;144 platform;145 playingfield;147 railroad;"
    "148 river;149 road;151 roof;154 sand;155 sea;156 shelf;159 snow;161 stairs;166 tent;168 towel;"
    "171 wall-brick;175 wall-stone;176 wall-tile;177 wall-wood;178 water-other;180 window-blind;"
    "181 window-other;184 tree-merged;185 fence-merged;186 ceiling-merged;187 sky-other-merged;"
    "188 cabinet-merged;189 table-merged;190 floor-other-merged;191 pavement-merged;192 mountain-merged;"
    "193 grass-merged;194 dirt-merged;195 paper-merged;196 food-other-merged;197 building-other-merged;"
    "198 rock-merged;199 wall-other-merged;200 rug-merged"
)
_COCO_NAMES = {int(number): name for number, name in (one.split(" ", 1) for one in _COCO_TEXT.split(";"))}
COCO = _listed(
    "coco",
    "panoptic_coco_categories.json of cocodataset/panopticapi: 1 ... 90 things, 92 ... 200 stuff, 0 void",
    (
        (0, "void", _C.OTHER),
        *((k, name, _COCO_CLASSES.get(name, _C.OTHER)) for k, name in _COCO_NAMES.items()),
    ),
)
COCO_80 = _renumbered(
    "coco-80",
    "the things of coco in their order: 0 person ... 79 toothbrush",
    COCO,
    (k for k in _COCO_NAMES if k <= 90),
)
COCO_133 = _renumbered(
    "coco-133",
    "all of coco in its order: 0 person ... 132 rug-merged",
    COCO,
    _COCO_NAMES,
)

_ADE20K_NAMES = (
    "wall;building;sky;floor;tree;ceiling;road;bed;windowpane;grass;cabinet;sidewalk;person;earth;door;"
    "table;mountain;plant;curtain;chair;car;water;painting;sofa;shelf;house;sea;mirror;rug;field;armchair;"
    "seat;fence;desk;rock;wardrobe;lamp;bathtub;railing;cushion;base;box;column;signboard;chest of drawers;"
    "counter;sand;sink;skyscraper;fireplace;refrigerator;grandstand;path;stairs;runway;case;pool table;"
    "pillow;screen door;stairway;river;bridge;bookcase;blind;coffee table;toilet;flower;book;hill;bench;"
    "countertop;stove;palm;kitchen island;computer;swivel chair;boat;bar;arcade machine;hovel;bus;towel;"
    "light;truck;tower;chandelier;awning;streetlight;booth;television receiver;airplane;dirt track;apparel;"
    "pole;land;bannister;escalator;ottoman;bottle;buffet;poster;stage;van;ship;fountain;conveyer belt;"
    "canopy;washer;plaything;swimming pool;stool;barrel;basket;waterfall;tent;bag;minibike;cradle;oven;"
    "ball;food;step;tank;trade name;microwave;pot;animal;bicycle;lake;dishwasher;screen;blanket;sculpture;"
    "hood;sconce;vase;traffic light;tray;ashcan;fan;pier;crt screen;plate;monitor;bulletin board;shower;"
    "radiator;glass;clock;flag"
)
"""In the order of their numbers, from 1 on."""
_ADE20K_CLASSES = {
    "wall": _C.IGNORE,
    "sky": _C.SKY,
    "person": _C.PERSON,
    "signboard": _C.SIGN,
    **dict.fromkeys(("car", "bus", "truck", "van"), _C.VEHICLE),
    **dict.fromkeys(("minibike", "bicycle"), _C.TWO_WHEELER),
    **dict.fromkeys(("floor", "road", "sidewalk", "path", "runway", "dirt track"), _C.GROUND),
    **dict.fromkeys(
        ("building", "windowpane", "door", "house", "column", "skyscraper", "hovel", "tower"), _C.BUILDING
    ),
    **dict.fromkeys(("tree", "plant", "flower", "palm"), _C.VEGETATION),
    **dict.fromkeys(("grass", "earth", "field", "sand", "hill", "land"), _C.TERRAIN),
    **dict.fromkeys(("fence", "railing", "bannister"), _C.FENCE),
    **dict.fromkeys(("streetlight", "pole"), _C.POLE),
}
ADE20K = _listed(
    "ade20k",
    "objectInfo150.txt of CSAILVision/sceneparsing: 1 wall ... 150 flag, 0 other",
    (
        (0, "other", _C.OTHER),
        *(
            (k, name, _ADE20K_CLASSES.get(name, _C.OTHER))
            for k, name in enumerate(_ADE20K_NAMES.split(";"), 1)
        ),
    ),
)
ADE20K_150 = _renumbered(
    "ade20k-150", "as ade20k without its 0: 0 wall ... 149 flag (networks)", ADE20K, range(1, 151)
)

_MAPILLARY = (
    (_C.OTHER, "Bird;Ground Animal"),
    (_C.GROUND, "Curb"),
    (_C.FENCE, "Fence;Guard Rail;Barrier;Wall"),
    (
        _C.GROUND,
        "Bike Lane;Crosswalk - Plain;Curb Cut;Parking;Pedestrian Area;Rail Track;Road;Service Lane;Sidewalk",
    ),
    (_C.OTHER, "Bridge"),
    (_C.BUILDING, "Building"),
    (_C.OTHER, "Tunnel"),
    (_C.PERSON, "Person"),
    (_C.TWO_WHEELER, "Bicyclist;Motorcyclist;Other Rider"),
    (_C.GROUND, "Lane Marking - Crosswalk;Lane Marking - General"),
    (_C.OTHER, "Mountain"),
    (_C.TERRAIN, "Sand"),
    (_C.SKY, "Sky"),
    (_C.TERRAIN, "Snow;Terrain"),
    (_C.VEGETATION, "Vegetation"),
    (_C.OTHER, "Water;Banner;Bench;Bike Rack;Billboard"),
    (_C.GROUND, "Catch Basin"),
    (_C.OTHER, "CCTV Camera;Fire Hydrant;Junction Box;Mailbox"),
    (_C.GROUND, "Manhole"),
    (_C.OTHER, "Phone Booth"),
    (_C.GROUND, "Pothole"),
    (_C.OTHER, "Street Light"),
    (_C.POLE, "Pole"),
    (_C.OTHER, "Traffic Sign Frame"),
    (_C.POLE, "Utility Pole"),
    (_C.OTHER, "Traffic Light"),
    (_C.SIGN, "Traffic Sign (Back);Traffic Sign (Front)"),
    (_C.OTHER, "Trash Can"),
    (_C.TWO_WHEELER, "Bicycle"),
    (_C.OTHER, "Boat"),
    (_C.VEHICLE, "Bus;Car;Caravan"),
    (_C.TWO_WHEELER, "Motorcycle"),
    (_C.VEHICLE, "On Rails;Other Vehicle;Trailer;Truck"),
    (_C.OTHER, "Wheeled Slow"),
    (_C.IGNORE, "Car Mount;Ego Vehicle"),
    (_C.OTHER, "Unlabeled"),
)
"""In the order of their numbers."""
_MAPILLARY_ROWS = [(name, label) for label, names in _MAPILLARY for name in names.split(";")]

MAPILLARY = _listed(
    "mapillary",
    "Mapillary Vistas 1.2 (config.json; mmseg/datasets/mapillary.py of open-mmlab/mmsegmentation): 0 ... 65",
    ((k, name, label) for k, (name, label) in enumerate(_MAPILLARY_ROWS)),
)

CLASS_MAPS: Mapping[str, ClassMap] = MappingProxyType(
    {
        one.name: one
        for one in (
            CITYSCAPES_IDS,
            CITYSCAPES_TRAIN_IDS,
            MAPILLARY,
            SEMANTIC_KITTI,
            SEMANTIC_KITTI_19,
            SEMANTIC_KITTI_20,
            NUSCENES_LIDARSEG,
            NUSCENES_16,
            NUSCENES_17,
            COCO,
            COCO_80,
            COCO_133,
            ADE20K,
            ADE20K_150,
        )
    }
)
"""All of them by name."""
