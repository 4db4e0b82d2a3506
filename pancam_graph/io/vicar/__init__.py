"""Files of VICAR's programs: tie points and pointing corrections of marsnav."""

from pancam_graph.io.vicar._identity import PictureIdentity as PictureIdentity
from pancam_graph.io.vicar._identity import picture_identities as picture_identities
from pancam_graph.io.vicar._nav_file import NavEntry as NavEntry
from pancam_graph.io.vicar._nav_file import NavFile as NavFile
from pancam_graph.io.vicar._nav_file import nav_text as nav_text
from pancam_graph.io.vicar._nav_file import nav_xml as nav_xml
from pancam_graph.io.vicar._nav_file import read_nav as read_nav
from pancam_graph.io.vicar._tie_file import PAIR_TYPES as PAIR_TYPES
from pancam_graph.io.vicar._tie_file import TIE_TYPES as TIE_TYPES
from pancam_graph.io.vicar._tie_file import AdjustedTie as AdjustedTie
from pancam_graph.io.vicar._tie_file import ReferenceFrame as ReferenceFrame
from pancam_graph.io.vicar._tie_file import Tie as Tie
from pancam_graph.io.vicar._tie_file import TieFile as TieFile
from pancam_graph.io.vicar._tie_file import read_ties as read_ties
from pancam_graph.io.vicar._tie_file import tie_text as tie_text
from pancam_graph.io.vicar._tie_file import tie_xml as tie_xml
from pancam_graph.io.vicar._traverse_of_files import Mark as Mark
from pancam_graph.io.vicar._traverse_of_files import TieSigmas as TieSigmas
from pancam_graph.io.vicar._traverse_of_files import image_rows as image_rows
from pancam_graph.io.vicar._traverse_of_files import joined as joined
from pancam_graph.io.vicar._traverse_of_files import with_pointing as with_pointing
from pancam_graph.io.vicar._traverse_of_files import with_rovers as with_rovers
from pancam_graph.io.vicar._traverse_of_files import with_ties as with_ties
