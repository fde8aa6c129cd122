/* Prints what SOEM reads from every EEPROM on a bus: eeprom IF
 *
 * SOEM's own example slaveinfo does the reading; it shows PDOs of devices with CoE as their objects
 * tell them, here they come from the EEPROM as well.
 */
#define main slaveinfo_main
#include "slaveinfo.c"
#undef main

static uint8 image[1 << 16];

static void eeprom(int n)
{
   char text[EC_MAXNAME + 1];
   ec_slavet *slave = &ec_slave[n];
   ec_eepromSMt sm;
   ec_eepromFMMUt fmmu;
   static ec_eepromPDOt pdo;
   int more, general = ec_siifind(n, ECT_SII_GENERAL);

   printf("device %08x %08x %08x %08x %04x\n", slave->eep_man, slave->eep_id, slave->eep_rev, slave->eep_sn,
          slave->aliasadr);
   printf("name %s\n", slave->name);
   for (int field = 0; field < 4; field++)
   {
      *text = 0;
      if (ec_siigetbyte(n, general + 2 + field))
         ec_siistring(text, n, ec_siigetbyte(n, general + 2 + field));
      printf("text %d %s\n", field, text);
   }
   printf("mailbox %04x %d %04x %d %02x\n", slave->mbx_wo, slave->mbx_l, slave->mbx_ro, slave->mbx_rl,
          slave->mbx_proto);
   printf("details %02x %02x %02x %02x %d %d\n", slave->CoEdetails, slave->FoEdetails, slave->EoEdetails,
          slave->SoEdetails, slave->blockLRW, slave->Ebuscurrent);
   if (ec_siiSM(n, &sm))
   {
      int number = 0;
      do
      {
         int at = sm.Startpos + 2 + 8 * number;
         printf("sm %04x %d %02x %02x %d\n", etohs(sm.PhStart), etohs(sm.Plength), sm.Creg, sm.Activate,
                ec_siigetbyte(n, at + 7));
         more = ec_siiSMnext(n, &sm, ++number);
      } while (more);
   }
   if (ec_siiFMMU(n, &fmmu))
      printf("fmmu %d %d %d %d %d\n", fmmu.nFMMU, slave->FMMU0func, slave->FMMU1func, slave->FMMU2func,
             slave->FMMU3func);
   printf("bits %d %d\n", (int)ec_siiPDO(n, &pdo, 1), (int)ec_siiPDO(n, &pdo, 0));
   si_map_sii(n);
}

int main(int argc, char **argv)
{
   if (argc != 2 || !ec_init(argv[1]))
      return fprintf(stderr, "eeprom IF\n"), 2;
   if (ec_config_init(FALSE) <= 0)
      return fprintf(stderr, "no device answers\n"), 1;
   for (int n = 1; n <= ec_slavecount; n++)
      eeprom(n);
   /* The contents of the EEPROM alone, without mailbox data. */
   for (int n = 1; n <= ec_slavecount; n++)
      ec_slave[n].mbx_proto = 0;
   ec_config_map(image);
   ec_configdc();
   for (int n = 1; n <= ec_slavecount; n++)
      printf("mapped %d %d %d %02x\n", ec_slave[n].Obits, ec_slave[n].Ibits, ec_slave[n].hasdc, ec_slave[n].ptype);
   ec_slave[0].state = EC_STATE_INIT;
   ec_writestate(0);
   ec_close();
   return 0;
}
